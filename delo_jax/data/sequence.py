"""A sequence of scans and what is known about it."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int64

from delo_jax.data.fields import RawScan
from delo_jax.data.scans import read_scan

KITTI_ELEVATION_CORRECTION_DEG = 0.205
KITTI_SWEEP_S = 0.1035  # one turn of its HDL-64
_SHORTEST_SPACING_S, _LONGEST_SPACING_S = 0.03, 0.3  # of stamps that tell how long a turn takes


def correct_elevation(points: Float32[np.ndarray, "n 3"], angle_deg: float) -> Float32[np.ndarray, "n 3"]:
    """Points lifted by an angle as seen from the sensor; range and azimuth are kept.

    The factory calibration of KITTI's HDL-64 is off by 0.205 deg; every well-known odometry corrects for it.

    Args:
        points: sensor frame [m].
        angle_deg: added to the elevation of every point.
    """
    angle = np.deg2rad(angle_deg)
    cos, sin = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    x, y, z = points.T
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):  # rows that are not finite stay so
        horizontal = np.hypot(x, y)
        shrink = np.where(horizontal > 0, cos - sin * z / np.where(horizontal > 0, horizontal, 1), 1)
        return np.stack([x * shrink, y * shrink, sin * horizontal + cos * z], axis=-1)


def azimuth_times(points: Float32[np.ndarray, "n 3"], *, sweep_s: float = KITTI_SWEEP_S) -> Float64[np.ndarray, " n"]:
    """Times [s] relative to the stamp of a sensor that turns clockwise, starts and ends behind and is stamped when it looks ahead.

    Args:
        points: sensor frame [m]; those that are not finite get 0.
        sweep_s: how long a turn takes.
    """
    with np.errstate(invalid="ignore"):
        azimuth = np.arctan2(points[:, 1], points[:, 0])
    return np.nan_to_num(azimuth, nan=0.0).astype(np.float64) / (-2 * np.pi) * sweep_s


def median_spacing_s(stamps_ns: Int64[np.ndarray, " n"] | None) -> float | None:
    """Median time between neighbouring scans; None where there are no two stamps."""
    return None if stamps_ns is None or len(stamps_ns) < 2 else float(np.median(np.diff(stamps_ns))) * 1e-9


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Dataset:
    """Scans in order, read one by one; a damaged scan raises `ScanError` only when it is asked for."""

    name: str
    layout: str
    """What was found, in words."""
    paths: tuple[Path, ...]
    stamps_ns: Int64[np.ndarray, " n"] | None = None
    """Strictly increasing; None where unknown."""
    truth: Float64[np.ndarray, "n 4 4"] | None = None
    """T_first_lidar: sensor poses in the frame of the first scan."""
    truth_source: str = "none"
    T_cam_lidar: Float64[np.ndarray, "4 4"] | None = None
    elevation_correction_deg: float = 0.0
    """Added to every point's elevation; 0 where none is applied."""
    compensated: bool | None = None
    """Whether the scans are motion-compensated; None where unknown."""
    point_times: str = "none"
    """'none', 'stored' or 'azimuth': where the times of a scan come from."""
    center_times: bool = False
    """Stored times are of a clock that runs on from scan to scan: deliver them relative to the middle of each sweep."""
    bin_columns: int | None = None
    """Columns that .bin scans must have; None where they tell themselves."""
    notes: tuple[str, ...] = ()
    """Things a user should know, such as files that were left out."""

    @property
    def sweep_s(self) -> float:
        """How long a turn of the sensor takes: the median spacing of the stamps, else that of KITTI."""
        spacing_s = median_spacing_s(self.stamps_ns)
        return spacing_s if spacing_s and _SHORTEST_SPACING_S <= spacing_s <= _LONGEST_SPACING_S else KITTI_SWEEP_S

    def __len__(self) -> int:
        """Number of scans."""
        return len(self.paths)

    def __getitem__(self, index: int) -> RawScan:
        """Scan `index`, corrected as this dataset says.

        Raises:
            ScanError: the file cannot be used.
            IndexError: no such scan.
        """
        points, times = read_scan(self.paths[index], bin_columns=self.bin_columns)
        if self.elevation_correction_deg:
            points = correct_elevation(points, self.elevation_correction_deg)
        if self.point_times == "azimuth":
            return RawScan(points, azimuth_times(points, sweep_s=self.sweep_s))
        if self.point_times == "none" or times is None:
            return RawScan(points, None)
        return RawScan(points, times - (times.min() + times.max()) / 2 if self.center_times else times)

    def __iter__(self) -> Iterator[RawScan]:
        """Scans in order."""
        return (self[index] for index in range(len(self)))

    def describe(self) -> list[str]:
        """Lines for a user: what was found and what is done to it."""
        lines = [f"{self.layout}: {self.name}, {len(self)} scans"]
        if self.stamps_ns is None:
            lines.append("stamps: none (index times 0.1 s)")
        elif (spacing_s := median_spacing_s(self.stamps_ns)) is not None:
            lines.append(f"stamps: one per scan, {1e3 * spacing_s:.1f} ms apart (median)")
        if self.truth is None:
            lines.append("truth: none")
        else:
            length = np.linalg.norm(np.diff(self.truth[:, :3, 3], axis=0), axis=1).sum()
            lines.append(f"truth: {self.truth_source}, {length:.1f} m")
        if self.elevation_correction_deg:
            lines.append(f"elevation correction: {self.elevation_correction_deg:+g} deg")
        else:
            lines.append("elevation correction: none")
        compensated = {True: "yes (as the layout says)", False: "no", None: "unknown"}[self.compensated]
        lines.append(f"motion-compensated: {compensated}; point times: {self.point_times}")
        return lines + [f"note: {note}" for note in self.notes]
