"""Pairs of scans with all that is said of their uncertainty: simulated clips, scans made bad, recorded drives."""

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from _peers import Sweep
from rich.progress import Progress

from delo_jax import inference
from delo_jax.config import PreprocessConfig
from delo_jax.geometry import se3
from delo_jax.inference import PreparedScan
from delo_jax.model.delo import Model
from delo_jax.pipeline.motion_model import NANOSECOND
from delo_jax.preprocess import Scan, preprocess
from delo_jax.sim import KINDS, simulate_clip
from delo_jax.train.worlds import SIMULATOR, World, read_world, write_world
from delo_jax.uncertainty import covariance
from delo_jax.uncertainty.covariance import Uncertainty

CLIP_SEED = 1_650_000  # of the first clip; no training, calibration or other experiment uses seeds from here on
OFF_M, OFF_DEG = 0.3, 1.0
LIMITS = np.repeat([np.radians(OFF_DEG), OFF_M], 3)
NOISE_BOX_M = np.array([[-50.0, -50.0, -2.0], [50.0, 50.0, 10.0]])
SHIFT_M, DROPPED, RAIN_DROPPED, RAIN_RETURNS, RAIN_M = 3.0, 0.9, 0.3, 0.15, (2.7, 3.0)


class Said(NamedTuple):
    """What is said of one pair, and what its pose got wrong."""

    error: np.ndarray  # (6,) log(T_estimated^-1 T_true), [omega, v]; infinite where there is no truth, or no pose
    confidence: float
    evidence: Uncertainty  # of the head as it is
    full: Uncertainty  # calibrated

    @property
    def off(self) -> bool:
        """Whether the pose is off by more than what counts."""
        return not (np.linalg.norm(self.error[:3]) <= LIMITS[0] and np.linalg.norm(self.error[3:]) <= LIMITS[3])


def solved(model: Model, source: PreparedScan, target: PreparedScan, T_true: np.ndarray | None) -> Said:
    """A pair from the identity, without a motion prior; of scans with too few points nothing is known."""
    limits = model.cfg.status
    result = inference.solve(model, source.encoding, target.encoding, jnp.eye(4))
    result, (half, doubt) = jax.device_get((result, inference.pair_covariance(model, result)))
    nothing = np.full(6, np.inf)
    if not result.finite or min(source.num_points, target.num_points) < limits.min_points:
        return Said(nothing, 0.0, *[covariance.unknown(limits)] * 2)
    T, nig = se3.orthonormal(np.asarray(result.T_target_source, np.float64)), [np.asarray(array, np.float64) for array in result.nig]
    error = nothing if T_true is None else se3.log(se3.inverse(T) @ T_true)
    full = covariance.from_half(np.asarray(half, np.float64), float(doubt))
    return Said(error, float(result.confidence), covariance.from_evidence(*nig), full)


def relative(Ts_world_lidar: np.ndarray, source: int, target: int) -> np.ndarray:
    """True T_target_source."""
    return se3.inverse(Ts_world_lidar[target]) @ Ts_world_lidar[source]


def prepared(model: Model, scan: Scan) -> PreparedScan:
    """A preprocessed scan without times."""
    return PreparedScan(params=model, scan=scan, measured=scan, times_s=None)


def thinned(columns: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A tenth of the points."""
    return columns[rng.random(len(columns)) >= DROPPED]


def half_shifted(columns: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The points on one side of a vertical plane through the sensor, moved along the ground."""
    heading, towards = rng.uniform(-np.pi, np.pi, 2)
    side = columns[:, 0] * np.cos(heading) + columns[:, 1] * np.sin(heading) > 0.0
    move = np.float32(SHIFT_M) * side[:, None] * np.array([np.cos(towards), np.sin(towards), 0.0], np.float32)
    return _with_points(columns, columns[:, :3] + move)


def noise(columns: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """As many points, uniform in a box."""
    return _with_points(columns, rng.uniform(NOISE_BOX_M[0], NOISE_BOX_M[1], (len(columns), 3)))


def rain(columns: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Some points lost, some rays returned by drops close to the sensor."""
    columns = columns[rng.random(len(columns)) >= RAIN_DROPPED]
    ranges = np.linalg.norm(columns[:, :3], axis=1)
    drops = RAIN_M[0] + rng.exponential(RAIN_M[1], len(columns))
    struck = (rng.random(len(columns)) < RAIN_RETURNS) & (drops < ranges)
    return _with_points(columns, columns[:, :3] * np.where(struck, drops / np.maximum(ranges, 1e-6), 1.0)[:, None])


def _with_points(columns: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Other points in the first three columns."""
    return np.concatenate([points.astype(np.float32), columns[:, 3:]], axis=1)


Change = Callable[[np.ndarray, np.random.Generator], np.ndarray]  # of rows of three columns or more, of which the first are a point


def clips(
    folder: Path,
    count: int,
    *,
    num_frames: int,
    cfg: PreprocessConfig,
    bar: Progress,
    sensor: str = "hdl64e",
    also: tuple[tuple[int, Change], ...] = (),
) -> Iterator[World]:
    """Clips of worlds that no training has seen, as measured, read from `folder` or simulated and written there.

    Args:
        folder: store.
        count: how many.
        num_frames: scans of each, 0.1 s apart.
        cfg: preprocessing.
        bar: progress.
        sensor: model of the sensor; world and motion are the same for each.
        also: more scans, behind the others: (frame, what is done to its points).
    """
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps([SIMULATOR, asdict(cfg), num_frames, sensor, CLIP_SEED, [(frame, change.__name__) for frame, change in also]])
    fingerprint = hashlib.sha256(text.encode()).hexdigest()[:8]
    for index in bar.track(range(count), description=f"{sensor} clips"):
        path = folder / f"clip_{fingerprint}_{index:05d}.npz"
        if not path.exists():
            seed = CLIP_SEED + index
            clip = simulate_clip(KINDS[index % len(KINDS)], seed, num_frames=num_frames, sensor=sensor)
            rng = np.random.default_rng([seed, 83])
            changed = [clip[frame]._replace(points=change(clip[frame].points, rng)) for frame, change in also]
            scans = [preprocess(scan.points, cfg) for scan in clip + changed]
            stacked = Scan(*(np.stack(arrays) for arrays in zip(*scans, strict=True)))
            write_world(path, World(stacked, np.stack([scan.T_world_lidar for scan in clip + changed])))
        yield read_world(path)


def frame_of(model: Model, world: World, frame: int) -> PreparedScan:
    """One scan of a clip."""
    return prepared(model, Scan(*(array[frame] for array in world.scans)))


def sizes(uncertainties: list[Uncertainty], part: str) -> np.ndarray:
    """(n,) standard deviations over what counts as off: `epistemic`, or `total`."""
    variances = [np.diag(known.covariance) if part == "total" else known.epistemic for known in uncertainties]
    return np.sqrt(np.mean(np.array(variances) / LIMITS**2, axis=1))


def prepared_sweep(model: Model, sweep: Sweep, change: Callable[[np.ndarray], np.ndarray] = lambda columns: columns) -> PreparedScan:
    """A recorded scan as measured, or what a change makes of its points, with their times in a fourth column where there are any."""
    if sweep.times_s is None:
        return inference.prepare(model, change(sweep.points))
    columns = change(np.column_stack([sweep.points, sweep.times_s.astype(np.float32)]))
    return inference.prepare(model, columns[:, :3], columns[:, 3])


def deskewed(model: Model, source: PreparedScan, target: PreparedScan, spacing_ns: int) -> tuple[PreparedScan, PreparedScan]:
    """Both scans de-skewed with the motion estimated from them as measured; as they are where points carry no times."""
    if source.times_s is None and target.times_s is None:
        return source, target
    estimate = inference.align(model, source, target, np.eye(4))
    if estimate.status == "rejected":
        return source, target
    velocity = se3.log(se3.inverse(estimate.T_target_source)) / (spacing_ns * NANOSECOND)
    return source.still(velocity), target.still(velocity)
