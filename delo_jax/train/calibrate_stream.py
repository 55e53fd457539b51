"""Covariances of a drive on a map that fit the errors: simulated drives that no training has seen, and the numbers of `stream` fitted."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from scipy.stats import norm

from delo_jax.data.fields import FRAME_PERIOD_NS
from delo_jax.errors import WeightsError
from delo_jax.geometry import se3
from delo_jax.model.delo import Model
from delo_jax.pipeline.lidar_odometry import LidarOdometry
from delo_jax.pipeline.motion_model import NANOSECOND
from delo_jax.sim import KINDS, simulate_drive
from delo_jax.train.calibrate import LEVELS, fingerprint
from delo_jax.train.worlds import SIMULATOR, write_arrays
from delo_jax.uncertainty import stream
from delo_jax.uncertainty.stream import StreamNoise

DRIVE_SEED = 1_300_000  # of the first drive that is fitted on
NUM_SCANS = 120
COMPENSATED = 4  # one drive in so many is delivered without times
TRACKER = 1  # counts the changes of `delo_jax.pipeline` that change an error; stored drives of another are not used
GAPS = (1, 10, 100)  # frames, of the motions whose errors are fitted
WORLD = 0  # in place of a gap: the pose in the world
NUM_FOLDS, MAX_STEPS = 8, 300
UNITS = np.repeat([1e-3, 1e-2], 3)  # rad, m
START = StreamNoise(0.1, 0.007, 0.01, 0.02, 0.0024, 0.06, 0.0025)  # the pitch begins at 0, from where either sign is found


class Drive(NamedTuple):
    """What the odometry made of a simulated drive, frame by frame."""

    Ts_true: np.ndarray  # (n, 4, 4) float64
    Ts_world_lidar: np.ndarray  # (n, 4, 4) float64
    classical: np.ndarray  # (n, 6, 6) covariance of each registration
    good: np.ndarray  # (n,) on the map, with status ok, since the frame before
    timed: np.ndarray  # () points carried times


class Segments(NamedTuple):
    """Errors of motions and poses, row by row, and what their covariances are made of; in `UNITS`."""

    errors: np.ndarray  # (m, 6) log(T_estimated^-1 T_true), [omega, v]
    ends: np.ndarray  # (m, 6, 6) registrations at both ends
    carry: np.ndarray  # (m, 6, 6) from the perturbation of the start to that of the end
    squares: np.ndarray  # (m, 2, 6) changes of the velocity at both ends
    way: np.ndarray  # (m, 6, 6) registrations along the way, per metre
    forward: np.ndarray  # (m, 6, 6) metres along the way, in x
    gaps: np.ndarray  # (m,) frames, or WORLD
    drives: np.ndarray  # (m,) number of the drive

    def rows(self, which: np.ndarray) -> "Segments":
        """Some of them."""
        return Segments(*(array[which] for array in self))


def register_drive(model: Model, seed: int, num_scans: int, on_scan: Callable[[], None] = lambda: None) -> Drive:
    """A simulated drive through the odometry; kinds of the world take turns, one drive in four is compensated.

    Args:
        model: weights.
        seed: of the drive.
        num_scans: one every 0.1 s.
        on_scan: called after each scan, for progress.
    """
    timed = seed % COMPENSATED != COMPENSATED - 1
    plain = {name: value for name, value in model.variables.items() if name != stream.NAME}
    odometry, rows = LidarOdometry(replace(model, variables=plain)), []
    for k, scan in enumerate(simulate_drive(KINDS[seed % len(KINDS)], seed, num_scans, rolling_shutter=timed)):
        frame = odometry.register(scan.points, k * FRAME_PERIOD_NS, scan.times_s if timed else None)
        good = frame.status == "ok" and frame.since == max(k - 1, 0)
        rows.append((scan.T_world_lidar, frame.T_world_lidar, frame.motion.covariance, good))
        on_scan()
    Ts_true, Ts_world_lidar, classical, usable = (np.stack(arrays) for arrays in zip(*rows, strict=True))
    return Drive(Ts_true, Ts_world_lidar, classical, usable, np.array(timed))


def stored_drives(
    folder: Path, model: Model, count: int, seed: int, *, num_scans: int = NUM_SCANS, on_scan: Callable[[], None] = lambda: None
) -> Iterator[Drive]:
    """Drives `seed`, `seed + 1`, ..., read from `folder`, or simulated, registered and written there.

    Args:
        folder: store; drives of other weights do not get mixed up, since the file name holds a fingerprint.
        model: weights.
        count: how many.
        seed: of the first.
        num_scans: of each drive.
        on_scan: called after each scan, for progress.
    """
    folder.mkdir(parents=True, exist_ok=True)
    key = fingerprint(model, SIMULATOR, TRACKER, num_scans)
    for number in range(seed, seed + count):
        path = folder / f"drive_{key}_{number:07d}.npz"
        if path.exists():
            for _ in range(num_scans):
                on_scan()
        else:
            write_arrays(path, **register_drive(model, number, num_scans, on_scan)._asdict())
        with np.load(path) as stored:
            yield Drive(*(stored[name] for name in Drive._fields))


def segments(drives: Sequence[Drive]) -> Segments:
    """Every motion over 1, 10 and 100 frames and every pose in the world, of drives of which all frames up to there are good."""
    rows: list[Segments] = []
    for number, drive in enumerate(drives):
        registrations, squares, forward = _noise_parts(drive)
        bad = np.concatenate([[0], np.cumsum(~drive.good)])
        num = len(drive.good)
        motions = [(gap, k, k + gap) for gap in GAPS for k in range(1, num - gap)]
        for gap, start, end in motions + [(WORLD, 0, k) for k in range(1, num)]:
            if bad[end + 1] > bad[start]:
                continue
            first = max(start, 1)  # the first scan of all is taken to be as wrong as the one after it
            Ad = se3.adjoint(se3.inverse(drive.Ts_world_lidar[end]) @ drive.Ts_world_lidar[first : end + 1]) / UNITS[:, None]
            carried = Ad @ registrations[first : end + 1] @ Ad.transpose(0, 2, 1)
            along = slice(start + 1 - first, None)
            ways = forward[start + 1 : end + 1, None, None]
            found, true = (se3.inverse(Ts[start]) @ Ts[end] for Ts in (drive.Ts_world_lidar, drive.Ts_true))
            row = Segments(
                errors=se3.log(se3.inverse(found) @ true) / UNITS,
                ends=carried[0] + carried[-1],
                carry=Ad[0] * UNITS[None],
                squares=squares[[first, end]],
                way=np.sum(ways * carried[along], axis=0),
                forward=np.sum(ways * Ad[along, :, 3:4] * Ad[along, None, :, 3], axis=0),
                gaps=np.array(gap),
                drives=np.array(number),
            )
            rows.append(row)
    if not rows:
        raise WeightsError("weights: expected some motions on the map with status ok, got none on any drive; train them first")
    return Segments(*(np.stack(arrays) for arrays in zip(*rows, strict=True)))


def _noise_parts(drive: Drive) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each frame: covariance of its registration, squared changes of the velocity, metres since the last one."""
    motions = se3.inverse(drive.Ts_world_lidar[:-1]) @ drive.Ts_world_lidar[1:]
    swing, squares = stream.STEADY, [np.zeros(6)]
    for velocity in se3.log(motions) / (FRAME_PERIOD_NS * NANOSECOND):
        swing = swing.after(velocity)
        squares.append(swing.squares if drive.timed else np.zeros(6))
    return drive.classical, np.stack(squares), np.concatenate([[0.0], np.linalg.norm(motions[:, :3, 3], axis=1)])


def covariances(numbers: StreamNoise, rows: Segments) -> Any:
    """(m, 6, 6) in `UNITS`: what `stream.Standing` says of the same motions and poses."""
    K = numbers.of_swing() / UNITS[:, None]
    parts = numbers.share**2 * rows.ends + numbers.drift_share**2 * rows.way + numbers.drift_forward**2 * rows.forward
    for turned, squares in ((rows.carry @ K[None], rows.squares[:, 0]), (K[None], rows.squares[:, 1])):
        parts = parts + (turned * squares[:, None, :]) @ turned.swapaxes(1, 2)
    return parts


def _numbers(free) -> StreamNoise:
    """From unbounded ones; all but the pitch are positive."""
    positive = {name: value * jnp.exp(free[name]) for name, value in START._asdict().items()}
    return StreamNoise(**(positive | {"heave_pitch": START.heave_pitch * free["heave_pitch"]}))


def fit(rows: Segments) -> StreamNoise:
    """Numbers that make the errors most likely, each gap and the world counting alike (BFGS of optimistix)."""
    weights = np.zeros(len(rows.gaps))
    for gap in np.unique(rows.gaps):
        weights[rows.gaps == gap] = 1.0 / np.sum(rows.gaps == gap)
    single = jax.tree.map(lambda array: jnp.asarray(array, jnp.float32), (rows, weights))

    def loss(free, given):
        seen, weights = given
        L = jnp.linalg.cholesky(covariances(_numbers(free), seen) + 1e-6 * jnp.eye(6)[None])
        white = jax.scipy.linalg.solve_triangular(L, seen.errors[:, :, None], lower=True)[..., 0]
        log_det = jnp.sum(jnp.log(jnp.diagonal(L, axis1=1, axis2=2)), axis=1)
        return jnp.sum(weights * (0.5 * jnp.sum(white**2, axis=1) + log_det))

    solver: Any = optimistix.BFGS(rtol=1e-5, atol=1e-6)
    start = {name: jnp.zeros(()) for name in StreamNoise._fields}
    found = optimistix.minimise(loss, solver, start, args=single, max_steps=MAX_STEPS, throw=False).value
    return StreamNoise(**{name: float(value) for name, value in _numbers(found)._asdict().items()})


def calibrate(model: Model, rows: Segments, on_fit: Callable[[], None] = lambda: None) -> tuple[Model, np.ndarray]:
    """The model with fitted numbers, and the covariances (m, 6, 6), in `UNITS`, by fits that had not seen their drives.

    What is on the map is scaled once more so that single motions fit, then the drift so that poses 100 frames apart do: by the
    geometric mean of what the coverages at 68 and 95 % of all axes ask for, on unseen drives.

    Args:
        model: weights.
        rows: from `segments`, of two drives or more.
        on_fit: called after each fit, of which there are `num_fits`.
    """
    fits: list[tuple[np.ndarray, StreamNoise]] = []
    drives = np.unique(rows.drives, return_inverse=True)[1]  # some may have left no row
    for fold in range(num_fits(rows) - 1):
        away = drives % (num_fits(rows) - 1) == fold
        fits.append((away, fit(rows.rows(~away))))
        on_fit()
    scales = np.ones(2)
    for which, gap in enumerate((GAPS[0], GAPS[-1])):
        near = rows.gaps == gap
        if near.any():
            scales[which] = _scale(rows.errors[near], _unseen(rows, fits, scales)[near])
    model = replace(model, variables=model.variables | {stream.NAME: _scaled(fit(rows), scales).stored()})
    on_fit()
    return model, _unseen(rows, fits, scales)


def num_fits(rows: Segments) -> int:
    """How many fits a calibration takes: one a fold, and the last one on all drives."""
    return min(NUM_FOLDS, len(np.unique(rows.drives))) + 1


def _unseen(rows: Segments, fits: list[tuple[np.ndarray, StreamNoise]], scales: np.ndarray) -> np.ndarray:
    result = np.zeros((len(rows.gaps), 6, 6))
    for away, numbers in fits:
        result[away] = covariances(_scaled(numbers, scales), rows.rows(away))
    return result


def _scaled(numbers: StreamNoise, scales: np.ndarray) -> StreamNoise:
    """With the sigmas on the map and those of the drift times a factor each."""
    factors = {name: scales[1 if name.startswith("drift") else 0] for name in StreamNoise._fields}
    return StreamNoise(**{name: float(value * factors[name]) for name, value in numbers._asdict().items()})


def _scale(errors: np.ndarray, covariances: np.ndarray) -> float:
    """What the standard deviations of all axes have to be multiplied by."""
    sizes = np.abs(errors) / np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    factors = [np.quantile(sizes, level) / norm.ppf(0.5 + 0.5 * level) for level in LEVELS]
    return float(np.exp(np.mean(np.log(factors))))
