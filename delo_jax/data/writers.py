"""Writes scans and KITTI odometry trees; trajectory files are written by `poses`."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped

from delo_jax.data.fields import FRAME_PERIOD_NS
from delo_jax.data.poses import format_kitti_pose, format_seconds, lidar_to_camera
from delo_jax.errors import DatasetError, ScanError

# x_cam = -y, y_cam = -z, z_cam = x, with offsets like those of KITTI's car
KITTI_LIKE_T_CAM_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])


def write_bin(path: str | Path, points: Shaped[np.ndarray, "n columns"]) -> None:
    """Writes a KITTI scan: rows of four little-endian float32, x y z [m] and a reflectance (0 where `points` has none).

    Raises:
        ScanError: neither three nor four columns.
    """
    if points.ndim != 2 or points.shape[1] not in (3, 4):
        raise ScanError(f"{path}: expected (n, 3) or (n, 4) points, got {points.shape}; drop the other columns")
    rows = np.zeros((len(points), 4), "<f4")
    rows[:, : points.shape[1]] = points
    Path(path).write_bytes(rows.tobytes())


class KittiTreeWriter:
    """Writes sequences/<name> and poses/<name>.txt of a KITTI odometry tree, scan by scan; a context manager.

    What was appended is on disk: a run that was interrupted or killed leaves a tree that `open_dataset` reads, for a scan takes its name
    only after its time and pose are written. calib.txt holds, beside Tr, what the
    scans need: two rows that other readers pass over.
    """

    def __init__(
        self,
        out: str | Path,
        name: str,
        *,
        T_cam_lidar: Float[np.ndarray, "4 4"] | None = None,
        motion_compensated: bool = True,
        elevation_correction_deg: float = 0.0,
    ):
        """Creates the folders.

        Args:
            out: root of the tree; other sequences in it are left alone.
            name: of the sequence.
            T_cam_lidar: calibration to write, in whose camera frame the poses are; a KITTI-like one by default.
            motion_compensated: whether the scans are; if not, they are read back with times by azimuth.
            elevation_correction_deg: what a reader shall add to the elevation: 0.205 for copies of KITTI's own scans.

        Raises:
            DatasetError: the sequence exists already, or the folder cannot be written.
        """
        self._T_cam_lidar = KITTI_LIKE_T_CAM_LIDAR if T_cam_lidar is None else T_cam_lidar
        self._count, self._first_ns, self._T_first_world = 0, 0, np.eye(4)
        self._folder = Path(out) / "sequences" / name
        poses_file = Path(out) / "poses" / f"{name}.txt"
        if poses_file.exists() or (self._folder.exists() and any(self._folder.iterdir())):
            raise DatasetError(f"{self._folder}: expected a new sequence, got one that exists; remove it or choose another name")
        try:
            (self._folder / "velodyne").mkdir(parents=True)
            poses_file.parent.mkdir(exist_ok=True)
            rows = [f"P{i}: {format_kitti_pose(np.eye(4))}" for i in range(4)]  # readers expect these; there are no cameras
            rows.append(f"Tr: {format_kitti_pose(self._T_cam_lidar)}")
            rows.append(f"elevation_correction_deg: {elevation_correction_deg}\nmotion_compensated: {int(motion_compensated)}\n")
            (self._folder / "calib.txt").write_text("".join(rows))
            self._times, self._poses = (self._folder / "times.txt").open("w"), poses_file.open("w")
        except OSError as error:
            raise DatasetError(f"{out}: expected a folder to write to, got {error.strerror or error}; choose another") from None

    def append(
        self, points: Shaped[np.ndarray, "n columns"], T_world_lidar: Float[np.ndarray, "4 4"], *, stamp_ns: int | None = None
    ) -> None:
        """Writes one scan with its time and pose, both relative to the first.

        Args:
            points: (n, 3) or (n, 4), sensor frame [m].
            T_world_lidar: sensor pose in any fixed frame.
            stamp_ns: middle of the sweep; index times 0.1 s by default.

        Raises:
            ScanError: neither three nor four columns.
        """
        stamp_ns = self._count * FRAME_PERIOD_NS if stamp_ns is None else stamp_ns
        if self._count == 0:
            self._first_ns, self._T_first_world = stamp_ns, np.linalg.inv(T_world_lidar)
        path = self._folder / "velodyne" / f"{self._count:06d}.bin"
        unnamed = path.with_name(f".{path.name}")
        write_bin(unnamed, points)
        T_first_lidar = self._T_first_world @ T_world_lidar
        self._poses.write(format_kitti_pose(lidar_to_camera(T_first_lidar[None], self._T_cam_lidar)[0]))
        self._times.write(format_seconds(stamp_ns - self._first_ns) + "\n")
        self._poses.flush()
        self._times.flush()
        unnamed.rename(path)
        self._count += 1

    def __enter__(self) -> "KittiTreeWriter":
        """The writer itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Closes the files."""
        self._times.close()
        self._poses.close()
