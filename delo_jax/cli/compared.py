"""An estimate and the truth of the same frames, brought into one sensor frame."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from delo_jax.cli.stored import facts_of, poses_of
from delo_jax.errors import DatasetError

NEAREST_NS = 10_000_000  # stamps of one frame in two files
WORDS = {"lidar": "LiDAR frame", "camera": "camera frame", "": "frame of the files"}


class Side(NamedTuple):
    """One of the two trajectories."""

    name: str
    Ts: np.ndarray  # (n, 4, 4)
    says: str = ""  # how it came into its frame


class Compared(NamedTuple):
    """Both of them."""

    estimate: Side
    truth: Side
    frame: str
    """Of the errors: "lidar", "camera", or empty where neither the files nor the motion say."""
    notes: tuple[str, ...]


def of_run(folder: Path, *, truth: Path | None, calib: Path | None, refined: bool) -> Compared:
    """A run's poses beside a file, or beside the truth of the run's own dataset.

    Raises:
        DatasetError: no run, no truth, or one of other frames.
    """
    facts = facts_of(folder)
    stamps_ns, Ts = poses_of(folder, facts, "refined_kitti.txt" if refined else "poses_kitti.txt")
    estimate = Side(f"{folder} ({facts.get('state', 'of unknown state')})", Ts, "a run's poses")
    own = folder / "truth.tum"
    if truth is None and not own.exists():
        found = _truth_of_dataset(folder, facts, len(stamps_ns))
        return _in_one_frame(estimate, found, None, known="lidar", same=True)
    T_cam_lidar = _calibration(calib)
    if T_cam_lidar is None and facts.get("T_cam_lidar") is not None:
        T_cam_lidar = np.array(facts["T_cam_lidar"], np.float64)
    path = truth or own
    true_ns, Ts_true = _read(path)
    if true_ns is not None:
        Ts_true = Ts_true[_nearest(path, true_ns, stamps_ns)]
    elif facts.get("state") != "complete":
        Ts_true = Ts_true[: len(stamps_ns)]  # an interrupted run has fewer frames
    # KITTI rows beside a run with a calibration are the camera's; TUM lines are the sensor's
    camera_rows = true_ns is None and T_cam_lidar is not None
    side = Side(str(path), Ts_true)
    return _in_one_frame(estimate, side, T_cam_lidar, known="lidar", camera_rows=camera_rows, same=truth is None)


def of_file(path: Path, *, truth: Path | None, calib: Path | None) -> Compared:
    """Poses of a file, KITTI rows or TUM lines, beside those of another.

    Raises:
        DatasetError: a file that cannot be read, no truth, or one of other frames.
    """
    if truth is None:
        raise DatasetError(f"{path}: expected a truth to compare this file with, got none; give one by --truth")
    stamps_ns, Ts = _read(path)
    true_ns, Ts_true = _read(truth)
    if stamps_ns is not None and true_ns is not None:
        Ts_true = Ts_true[_nearest(truth, true_ns, stamps_ns)]
    return _in_one_frame(Side(str(path), Ts), Side(str(truth), Ts_true), _calibration(calib), known="")


def _truth_of_dataset(folder: Path, facts: dict[str, Any], count: int) -> Side:
    from delo_jax.data.dataset import open_dataset

    dataset = facts.get("dataset") or {}
    if not dataset.get("path"):
        raise DatasetError(f"{folder}: expected a truth, got none in the run; give one by --truth")
    found = open_dataset(dataset["path"], sequence=dataset.get("sequence"))
    if found.truth is None:
        raise DatasetError(f"{dataset['path']}: expected a truth beside the scans, got none; give one by --truth")
    return Side(found.truth_source, found.truth[:count])  # an interrupted run has fewer frames


def _in_one_frame(
    estimate: Side, truth: Side, T_cam_lidar: np.ndarray | None, *, known: str, camera_rows: bool = False, same: bool = False
) -> Compared:
    """Both in the frame of one sensor, or a sentence that says why not.

    Args:
        estimate: as its file has it.
        truth: as its file has it.
        T_cam_lidar: calibration, where there is one.
        known: frame of the estimate, where something but its motion says so.
        camera_rows: the truth is to be in the camera frame.
        same: it is the run's own truth, in its frame: an estimate that moves otherwise is wrong, not mixed up.
    """
    from delo_jax.metrics.frames import compare_frames, sensor_of

    _check_counts(estimate, truth)
    found = compare_frames(estimate.Ts, truth.Ts)
    frames = known or sensor_of(found.estimated_axis), "camera" if camera_rows else sensor_of(found.true_axis)
    apart = camera_rows or not found.agree
    if apart and T_cam_lidar is not None and set(frames) == {"lidar", "camera"}:
        if frames[0] == "camera":
            estimate = _brought_to_lidar(estimate, T_cam_lidar)
        else:
            truth = _brought_to_lidar(truth, T_cam_lidar)
        again, frame = compare_frames(estimate.Ts, truth.Ts), "lidar"
    else:
        again, frame = found, known or sensor_of(found.estimated_axis) or sensor_of(found.true_axis)
    if not again.agree and not same:
        raise DatasetError(_misfit(truth.name, found, camera_rows))
    return Compared(estimate, truth, frame, tuple(_notes(found, again, converted=again is not found, calibrated=T_cam_lidar is not None)))


def _notes(found: Any, again: Any, *, converted: bool, calibrated: bool) -> Iterator[str]:
    """What a user should know of the frames, before and after the calibration."""
    axes = (axis or "none that tells" for axis in (found.estimated_axis, found.true_axis))
    yield "axis of the body along which it mostly moves, as the files have it: estimate {}, truth {}".format(*axes)
    if calibrated and not converted:
        yield "calibration not used: nothing says that the frames differ"
    if again.opposite:
        yield f"note: estimate and truth move in opposite directions ({again.angle_deg:.0f} deg apart); inverted poses do so"


def _misfit(name: str, found: Any, camera_rows: bool) -> str:
    """One sentence about a truth of another frame."""
    from delo_jax.metrics.frames import sensor_of

    def described(axis: str) -> str:
        kind = WORDS[sensor_of(axis)]
        return f"the {kind} (moving along {axis} of the body)" if sensor_of(axis) else f"a frame that moves along {axis} of the body"

    if camera_rows:
        got = described(found.true_axis) if found.true_axis else "others"
        expected = "KITTI rows in the camera frame of the calibration"
        return f"{name}: expected {expected}, got poses of {got}; give those of the camera, or a TUM file"
    remedy = "give the calibration that leads from one to the other by --calib"
    if {sensor_of(found.estimated_axis), sensor_of(found.true_axis)} != {"lidar", "camera"}:
        remedy = "bring both into one sensor frame"
    return (
        f"{name}: expected poses of {described(found.estimated_axis)} as those of the estimate, got {described(found.true_axis)}; {remedy}"
    )


def _brought_to_lidar(side: Side, T_cam_lidar: np.ndarray) -> Side:
    from delo_jax.data.poses import camera_to_lidar

    return Side(side.name, camera_to_lidar(side.Ts, T_cam_lidar), "camera frame, brought to the LiDAR frame with Tr")


def _check_counts(estimate: Side, truth: Side) -> None:
    if len(truth.Ts) != len(estimate.Ts):
        raise DatasetError(
            f"{truth.name}: expected one pose for each of {len(estimate.Ts)} frames, got {len(truth.Ts)}; give poses of the same frames"
        )
    if len(truth.Ts) < 2:
        raise DatasetError(f"{estimate.name}: expected two or more frames, got {len(truth.Ts)}; nothing moved")


def _calibration(path: Path | None) -> np.ndarray | None:
    """T_cam_lidar of a KITTI calib.txt."""
    from delo_jax.data.kitti import read_calib, rigid

    if path is None:
        return None
    calib = read_calib(path) if path.exists() else None
    if calib is None:
        raise DatasetError(f"{path}: expected a calib.txt, got nothing there; check --calib")
    return rigid(calib, "Tr_velo_to_cam" if "Tr_velo_to_cam" in calib else "Tr", path)


def _read(path: Path) -> tuple[np.ndarray | None, np.ndarray]:
    """Stamps, where the file has them, and poses: TUM lines have 8 numbers, KITTI rows 12."""
    from delo_jax.data.poses import read_kitti_poses, read_text, read_tum

    lines = (line.replace(",", " ").split() for line in read_text(path).splitlines())
    first = next((words for words in lines if words and not words[0].startswith("#")), [])
    return read_tum(path) if len(first) == 8 else (None, read_kitti_poses(path))


def _nearest(path: Path, true_ns: np.ndarray, stamps_ns: np.ndarray) -> np.ndarray:
    """Rows of the truth at the stamps of the frames."""
    order = np.argsort(true_ns, kind="stable")
    sorted_ns = true_ns[order]
    after = np.searchsorted(sorted_ns, stamps_ns).clip(0, len(sorted_ns) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(sorted_ns[before] - stamps_ns) <= np.abs(sorted_ns[after] - stamps_ns), before, after)
    far = np.abs(sorted_ns[nearest] - stamps_ns) > NEAREST_NS
    if far.any():
        raise DatasetError(
            f"{path}: expected a pose within 10 ms of every frame, got none for {far.sum()} of {len(stamps_ns)}; give one on the same clock"
        )
    return order[nearest]
