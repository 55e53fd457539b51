"""The trajectory of a run: kept in memory, saved as a whole, or written to files frame by frame.

Frames are read by attribute: T_world_lidar, covariance, local, stamp_ns, status, timing and motion, whose covariance, confidence and
reason are kept.
"""

import csv
import io
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int64
from scipy.spatial.transform import Rotation

from delo_jax.data.fields import FRAME_PERIOD_NS
from delo_jax.data.poses import format_kitti_pose, format_seconds, lidar_to_camera
from delo_jax.errors import DeloError

COVARIANCES = ("covariances", "pose_covariances", "local_covariances")
"""Files of a run: of the motions, of the poses, and the part of these that later poses do not inherit."""
COLUMNS = ("index", "since_index", "stamp_ns", "status", "reason", "confidence")
SIGMA_COLUMNS = ("sigma_rx_deg", "sigma_ry_deg", "sigma_rz_deg", "sigma_x_m", "sigma_y_m", "sigma_z_m")


class FrameRecord(NamedTuple):
    """What is kept of one frame."""

    number: int
    """Of the frame in its run, from 0."""
    since: int
    """Number of the frame that the motion starts from: the one before, or the last good one before bad scans."""
    stamp_ns: int
    T_world_lidar: Float64[np.ndarray, "4 4"]
    status: str
    reason: str
    confidence: float
    covariance: Float64[np.ndarray, "6 6"]
    """Of the motion from frame `since` to this one, order [omega, v]."""
    pose_covariance: Float64[np.ndarray, "6 6"]
    """Of T_world_lidar, order [omega, v]."""
    local_covariance: Float64[np.ndarray, "6 6"]
    """The part of it that later poses do not inherit."""
    timing: dict[str, float]
    """Stage to seconds."""

    @classmethod
    def of(cls, frame: Any, number: int) -> "FrameRecord":
        """Record of the frame with this number; a missing stamp becomes the number times 0.1 s."""
        return cls(
            number=number,
            since=int(frame.since),
            stamp_ns=number * FRAME_PERIOD_NS if frame.stamp_ns is None else int(frame.stamp_ns),
            T_world_lidar=np.array(frame.T_world_lidar, dtype=np.float64),
            status=str(frame.status),
            reason=str(frame.motion.reason or ""),
            confidence=float(frame.motion.confidence),
            covariance=np.array(frame.motion.covariance, dtype=np.float64),
            pose_covariance=np.array(frame.covariance, dtype=np.float64),
            local_covariance=np.array(frame.local, dtype=np.float64),
            timing=dict(frame.timing or {}),
        )

    @property
    def sigmas(self) -> Float64[np.ndarray, "6"]:
        """Standard deviations of the motion, order [omega (rad), v (m)]."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))


def kitti_row(record: FrameRecord, T_cam_lidar: Float[np.ndarray, "4 4"] | None = None) -> str:
    """One line of a KITTI file: the camera's pose in the first camera frame with a calibration, else T_world_lidar."""
    Ts = record.T_world_lidar[None]
    return format_kitti_pose((Ts if T_cam_lidar is None else lidar_to_camera(Ts, T_cam_lidar))[0])


def tum_row(record: FrameRecord) -> str:
    """One line of a TUM file: stamp [s], position [m] and quaternion_xyzw (w >= 0) of T_world_lidar."""
    quaternion = Rotation.from_matrix(record.T_world_lidar[:3, :3]).as_quat(canonical=True)
    numbers = [*record.T_world_lidar[:3, 3], *quaternion]
    return " ".join([format_seconds(record.stamp_ns), *(f"{number:.12g}" for number in numbers)]) + "\n"


def csv_header(timing_names: Sequence[str]) -> str:
    """First line of a frame table with these stages of the timing."""
    return _csv_line([*COLUMNS, *SIGMA_COLUMNS, *(f"{name}_ms" for name in timing_names)])


def csv_row(record: FrameRecord, timing_names: Sequence[str]) -> str:
    """One line of the frame table; a stage that this frame did not run is left empty.

    Raises:
        DeloError: the frame was timed in a stage that the header does not name.
    """
    unknown = [name for name in record.timing if name not in timing_names]
    if unknown:
        raise DeloError(f"timing: expected only {', '.join(timing_names) or 'no stage'}, got {', '.join(unknown)}")
    sigmas = np.concatenate([np.rad2deg(record.sigmas[:3]), record.sigmas[3:]])
    timing = [f"{1e3 * record.timing[name]:.3f}" if name in record.timing else "" for name in timing_names]
    reason = " ".join(record.reason.split())  # one frame, one line
    head = [record.number, record.since, record.stamp_ns, record.status, reason, f"{record.confidence:.6g}"]
    return _csv_line([*head, *(f"{sigma:.6g}" for sigma in sigmas), *timing])


def _csv_line(cells: Sequence[object]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(cells)
    return line.getvalue()


class Trajectory:
    """The frames of a run so far: about two kilobytes each, never a scan."""

    def __init__(self, frames: Iterable[Any] = ()):
        self.records: list[FrameRecord] = []
        for frame in frames:
            self.append(frame)

    def __len__(self) -> int:
        return len(self.records)

    def append(self, frame: Any) -> FrameRecord:
        """Keeps what is needed of the next frame and returns it."""
        self.records.append(FrameRecord.of(frame, len(self.records)))
        return self.records[-1]

    @property
    def Ts_world_lidar(self) -> Float64[np.ndarray, "n 4 4"]:
        """Sensor poses in the frame of the first scan."""
        return np.array([record.T_world_lidar for record in self.records]).reshape(-1, 4, 4)

    @property
    def stamps_ns(self) -> Int64[np.ndarray, " n"]:
        """Time of every frame."""
        return np.array([record.stamp_ns for record in self.records], dtype=np.int64)

    @property
    def statuses(self) -> tuple[str, ...]:
        """Status of every frame."""
        return tuple(record.status for record in self.records)

    @property
    def confidences(self) -> Float64[np.ndarray, " n"]:
        """Confidence of every motion, in [0, 1]."""
        return np.array([record.confidence for record in self.records], dtype=np.float64)

    @property
    def covariances(self) -> Float64[np.ndarray, "n 6 6"]:
        """Covariance of every motion, order [omega, v]."""
        return np.array([record.covariance for record in self.records]).reshape(-1, 6, 6)

    @property
    def pose_covariances(self) -> Float64[np.ndarray, "n 6 6"]:
        """Covariance of every pose in the world, order [omega, v]."""
        return np.array([record.pose_covariance for record in self.records]).reshape(-1, 6, 6)

    @property
    def local_covariances(self) -> Float64[np.ndarray, "n 6 6"]:
        """The part of them that later poses do not inherit."""
        return np.array([record.local_covariance for record in self.records]).reshape(-1, 6, 6)

    @property
    def sigmas(self) -> Float64[np.ndarray, "n 6"]:
        """Standard deviations of every motion, order [omega (rad), v (m)]."""
        return np.array([record.sigmas for record in self.records]).reshape(-1, 6)

    def save_kitti(self, path: str | os.PathLike[str], T_cam_lidar: Float[np.ndarray, "4 4"] | None = None) -> str:
        """Writes KITTI rows and returns the frame they are in: "camera" with a calibration, else "lidar"."""
        self._save(path, lambda record: kitti_row(record, T_cam_lidar))
        return "lidar" if T_cam_lidar is None else "camera"

    def save_tum(self, path: str | os.PathLike[str]) -> None:
        """Writes TUM rows, in the LiDAR frame."""
        self._save(path, tum_row)

    def save_csv(self, path: str | os.PathLike[str]) -> None:
        """Writes the frame table: stamp, status, confidence, sigmas and timing, units in the header."""
        timing_names = list(dict.fromkeys(name for record in self.records for name in record.timing))
        self._save(path, lambda record: csv_row(record, timing_names), header=csv_header(timing_names))

    def _save(self, path: str | os.PathLike[str], row: Callable[[FrameRecord], str], header: str = "") -> None:
        Path(path).write_text(header + "".join(map(row, self.records)), encoding="utf-8")


def _open(path: str | os.PathLike[str]) -> io.FileIO:
    """A new file without a buffer: what has been written survives the process."""
    return io.FileIO(path, "wb")


class CovarianceFile:
    """An .npy file of shape (n, 6, 6) that `np.load` reads at any instant while it grows.

    The header has a fixed length and is rewritten in one piece after a matrix has been appended: whoever reads in between, or after
    the process was killed, sees one matrix less and never half a one.
    """

    def __init__(self, path: str | os.PathLike[str]):
        self._file = _open(path)
        self._num = 0
        self._write_header()

    def append(self, covariance: Float64[np.ndarray, "6 6"]) -> None:
        """Writes one matrix."""
        self._file.seek(128 + 288 * self._num)  # over what an interrupted append may have left
        self._file.write(np.ascontiguousarray(covariance, dtype="<f8").tobytes())
        self._num += 1
        self._write_header()

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def _write_header(self) -> None:
        text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({self._num}, 6, 6), }}"
        header = np.lib.format.magic(1, 0) + (118).to_bytes(2, "little") + text.ljust(117).encode("latin1") + b"\n"  # 128 bytes
        self._file.seek(0)
        self._file.write(header)


class RunWriter:
    """Writes a run's files frame by frame, so that a run that was interrupted or killed leaves whole frames behind.

    poses_kitti.txt, trajectory.tum, frames.csv and the three covariance files are started anew; each frame adds one row to each of them,
    in one unbuffered write. After a kill between two of these writes the files differ by that one frame.

    Args:
        out_dir: the run's folder, made if missing.
        T_cam_lidar: calibration of the camera frame of poses_kitti.txt; without it the rows are in the LiDAR frame.
        timing_names: the stages a frame may be timed in, columns of frames.csv.
    """

    def __init__(
        self,
        out_dir: str | os.PathLike[str],
        *,
        T_cam_lidar: Float[np.ndarray, "4 4"] | None = None,
        timing_names: Sequence[str] = (),
    ):
        folder = Path(out_dir)
        folder.mkdir(parents=True, exist_ok=True)
        self.kitti_frame = "lidar" if T_cam_lidar is None else "camera"
        self.num_frames = 0
        self._T_cam_lidar, self._timing_names = T_cam_lidar, tuple(timing_names)
        self._covariances = [CovarianceFile(folder / f"{name}.npy") for name in COVARIANCES]
        self._kitti, self._tum, self._csv = (_open(folder / name) for name in ("poses_kitti.txt", "trajectory.tum", "frames.csv"))
        self._csv.write(csv_header(self._timing_names).encode())

    def append(self, frame: Any) -> None:
        """Adds the next frame to every file.

        Raises:
            DeloError: a stage of the timing was not announced; nothing is written.
        """
        record = FrameRecord.of(frame, self.num_frames)
        rows = kitti_row(record, self._T_cam_lidar), tum_row(record), csv_row(record, self._timing_names)
        matrices = record.covariance, record.pose_covariance, record.local_covariance
        for store, covariance in zip(self._covariances, matrices, strict=True):
            store.append(covariance)
        for file, row in zip((self._kitti, self._tum, self._csv), rows, strict=True):
            file.write(row.encode())
        self.num_frames += 1

    def close(self) -> None:
        """Closes the files."""
        for store in self._covariances:
            store.close()
        for file in (self._kitti, self._tum, self._csv):
            file.close()

    def __enter__(self) -> "RunWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
