"""Scans in, a run's folder out: what `run` and `demo` share."""

import dataclasses
import itertools
import json
import os
import platform
import sys
import time
from collections import Counter
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np

import delo_jax
from delo_jax.cli.command import Command
from delo_jax.cli.console import interruptible, progress
from delo_jax.cli.method import Opened, open_method, package_versions
from delo_jax.config import DeloConfig, to_toml
from delo_jax.data.fields import RawScan
from delo_jax.errors import ConfigError, DeloError, ScanError
from delo_jax.inference import PreparedScan
from delo_jax.model.delo import Model
from delo_jax.pipeline.baseline_odometry import BaselineOdometry
from delo_jax.pipeline.lidar_odometry import Frame, LidarOdometry
from delo_jax.pipeline.trajectory import RunWriter, Trajectory
from delo_jax.report.cloud import DriveCloud

if TYPE_CHECKING:  # graphs and figures are imported when they are made: the first pose does not wait for them
    from delo_jax.cli.refinement import Refinement
    from delo_jax.refine.refiner import Refiner, Tracked

STAGES = ("prepare", "solve", "insert")


@runtime_checkable
class Scans(Protocol):
    """Scans in order, taken one by one: a `Dataset`, or a drive that is simulated on the way."""

    @property
    def name(self) -> str:
        """For titles and folders."""

    @property
    def paths(self) -> Sequence[object]:
        """What to call each scan in a message."""

    @property
    def stamps_ns(self) -> np.ndarray | None:
        """Time of every scan."""

    @property
    def truth(self) -> np.ndarray | None:
        """(n, 4, 4) T_first_lidar of the scans, at least of those taken so far."""

    @property
    def T_cam_lidar(self) -> np.ndarray | None:
        """Calibration of the camera frame of poses_kitti.txt."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> RawScan: ...


@dataclasses.dataclass(frozen=True, kw_only=True)
class Job:
    """One run."""

    command: Command
    """Effective options; they go to config.toml."""
    source: Scans
    folder: Path
    weights: str | None
    """Released ones by name, or a file; None: a method without any."""
    use_map: bool
    deskew: bool
    refine: bool
    stamp_sigma_s: float
    stage: str
    """What getting a scan is called in the timing."""
    facts: dict[str, Any]
    """What run.json says about the data."""
    method: str = "delo"
    """Name in `baselines.registry`."""


class Result(NamedTuple):
    """What became of a job."""

    trajectory: Trajectory
    timing: dict[str, np.ndarray]
    """(n,) seconds per stage; NaN where a rejected scan did not come to it."""
    compile_s: float
    interrupted: bool
    truth: np.ndarray | None
    """Of the frames that were tracked."""
    refinement: "Refinement | None"
    cloud: DriveCloud
    """What the scans saw, thinned."""


@dataclasses.dataclass(frozen=True)
class _Effective:
    run: Command
    model: DeloConfig | None


def new_folder(asked: Path | None, name: str) -> Path:
    """Folder for a run: the one asked for, which must not hold a run yet, else runs/<name>, numbered where that exists.

    Raises:
        ConfigError: the folder holds a run.
    """
    if asked is None:
        names = itertools.chain([name], (f"{name}-{number}" for number in itertools.count(2)))
        return next(folder for folder in (Path("runs") / name for name in names) if not folder.exists())
    if (asked / "run.json").exists():
        raise ConfigError(f"--out {asked}: expected a folder without a run, got one that holds a run; choose another or delete it")
    return asked


def track(job: Job) -> Result:
    """Odometry over all scans of a job, written to its folder as it goes.

    Raises:
        DeloError: weights that cannot be used, a missing package, or a folder that cannot be written.
    """
    opened = open_method(job.method, weights_name=job.weights, use_map=job.use_map, deskew=job.deskew, stamp_sigma_s=job.stamp_sigma_s)
    odometry, params = opened.odometry, opened.params
    if opened.compile_s:
        print(f"compiled in {opened.compile_s:.1f} s")
    facts = _facts(job, opened)
    try:
        job.folder.mkdir(parents=True, exist_ok=True)
        (job.folder / "config.toml").write_text(to_toml(_Effective(job.command, None if params is None else params.cfg)))
        write_json(job.folder / "run.json", facts | {"state": "running"})
        writer = RunWriter(job.folder, T_cam_lidar=job.source.T_cam_lidar, timing_names=(job.stage, *STAGES))
    except OSError as error:
        raise ConfigError(f"--out {job.folder}: expected a folder to write to, got {error.strerror}; choose another") from error
    refiner, cloud = _refiner(params) if job.refine and params is not None else None, DriveCloud()
    try:
        with writer:
            acquired, interrupted = _loop(job, odometry, writer, refiner, cloud)
        result = _result(job, odometry.trajectory(), acquired, opened.compile_s, interrupted, cloud)
        _finish(job, result, facts)
        return result._replace(refinement=_refined(job, refiner, result.trajectory))
    finally:
        if refiner is not None:
            refiner.stop()


def _refiner(params: Model) -> "Refiner":
    from delo_jax.refine.refiner import Refiner

    return Refiner(params)


def _refined(job: Job, refiner: "Refiner | None", trajectory: Trajectory) -> "Refinement | None":
    """The pose graph of the run, written to its folder; where it fails, a sentence: the odometry stands without it."""
    if refiner is None or len(trajectory) < 2:
        return None
    from delo_jax.cli.refinement import refine, write

    try:
        found = refine(refiner.close(), refiner.Ts_world_lidar)
    except DeloError as error:
        print(f"delo: not refined: {error}", file=sys.stderr)
        return None
    write(job.folder, found, trajectory.stamps_ns, job.source.T_cam_lidar)
    return found


def _loop(
    job: Job, odometry: LidarOdometry | BaselineOdometry, writer: RunWriter, refiner: "Refiner | None", cloud: DriveCloud
) -> tuple[list[float], bool]:
    """All frames; the seconds it took to get each scan, and whether Ctrl-C ended it."""
    acquired: list[float] = []
    stamps_ns = job.source.stamps_ns
    with progress() as bar, interruptible() as interrupted:
        task = bar.add_task("odometry", total=len(job.source), note="")
        for index in range(len(job.source)):
            if interrupted():
                return acquired, True
            stamp_ns = None if stamps_ns is None else int(stamps_ns[index])
            begin = time.perf_counter()
            scan = _acquire(job.source, index)
            acquired.append(time.perf_counter() - begin)
            frame = _register(odometry, scan, stamp_ns)
            writer.append(frame._replace(timing={job.stage: acquired[-1], **frame.timing}))
            if refiner is not None and isinstance(odometry, LidarOdometry):
                refiner.add(_tracked(frame, odometry.last_scan))
            if frame.status != "rejected" and not isinstance(scan, str):
                if isinstance(odometry, LidarOdometry):
                    cloud.add_scan(index, frame.T_world_lidar, odometry.last_scan or scan)
                else:
                    cloud.add_scan(index, frame.T_world_lidar, scan, odometry.velocity)
            bar.advance(task)
    return acquired, False


def _tracked(frame: Frame, scan: PreparedScan | None) -> "Tracked":
    from delo_jax.refine.refiner import Tracked

    return Tracked(frame.since, frame.T_world_lidar, frame.covariance, frame.local, scan)


def _acquire(source: Scans, index: int) -> RawScan | str:
    """The scan, or why there is none."""
    try:
        return source[index]
    except ScanError as error:
        return str(error)


def _register(odometry: LidarOdometry | BaselineOdometry, scan: RawScan | str, stamp_ns: int | None) -> Frame:
    """The frame of a scan; a scan that cannot be used is a rejected frame, not the end of the drive."""
    if isinstance(scan, str):
        return odometry.reject(scan, stamp_ns)
    try:
        return odometry.register(scan.points, stamp_ns, scan.times)
    except ScanError as error:
        return odometry.reject(str(error), stamp_ns)


def _result(job: Job, trajectory: Trajectory, acquired: list[float], compile_s: float, interrupted: bool, cloud: DriveCloud) -> Result:
    timing = {name: np.array([record.timing.get(name, np.nan) for record in trajectory.records]) for name in STAGES}
    truth = None if job.source.truth is None else job.source.truth[: len(trajectory)]
    return Result(trajectory, {job.stage: np.array(acquired), **timing}, compile_s, interrupted, truth, None, cloud)


def percentiles_ms(seconds: np.ndarray) -> tuple[float, float] | None:
    """Median and 95th percentile [ms] of the frames that went through a stage; None where none did."""
    known = seconds[np.isfinite(seconds)]
    return (round(1e3 * float(np.median(known)), 3), round(1e3 * float(np.percentile(known, 95)), 3)) if len(known) else None


def _finish(job: Job, result: Result, facts: dict[str, Any]) -> None:
    """The picture, and run.json as it is now known."""
    trajectory = result.trajectory
    counts = dict(Counter(trajectory.statuses))
    timing = {name: dict(zip(("p50", "p95"), percentiles_ms(seconds) or (), strict=False)) for name, seconds in result.timing.items()}
    state = "interrupted" if result.interrupted else "complete"
    write_json(job.folder / "run.json", facts | {"state": state, "frames": counts, "timing_ms": timing})
    if len(trajectory):
        known = bool(np.isfinite(trajectory.confidences).any())  # NaN of a method without uncertainty
        from delo_jax.report.figures import trajectory_figure

        trajectory_figure(
            job.folder / "trajectory.png",
            trajectory.Ts_world_lidar,
            trajectory.statuses,
            sigmas=trajectory.sigmas if known else None,
            confidences=trajectory.confidences if known else None,
            truth=result.truth,
            title=f"{job.source.name}, {len(trajectory)} scans",
        )


def _facts(job: Job, opened: Opened) -> dict[str, Any]:
    T_cam_lidar = job.source.T_cam_lidar
    return {
        "versions": {
            "delo-jax": delo_jax.__version__,
            "jax": jax.__version__,
            "numpy": version("numpy"),
            "python": platform.python_version(),
            **package_versions(job.method),
        },
        **opened.facts,
        **job.facts,
        "num_scans": len(job.source),
        "poses_kitti_frame": "lidar" if T_cam_lidar is None else "camera",
        "T_cam_lidar": None if T_cam_lidar is None else T_cam_lidar.tolist(),
    }


def write_json(path: Path, table: dict[str, Any]) -> None:
    """Writes a JSON file in one piece: who reads it sees the old or the new one."""
    part = path.with_suffix(".part")
    part.write_text(json.dumps(table, indent=2) + "\n")
    os.replace(part, path)
