"""Scan to local map: learned steps for the wide basin, robust classical steps for the last millimetres."""

import dataclasses
import itertools
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from delo_jax import inference
from delo_jax.config import require
from delo_jax.errors import ConfigError
from delo_jax.geometry import se3
from delo_jax.geometry.point_to_plane import RobustFit, SweepFit
from delo_jax.inference import Estimate, PreparedScan
from delo_jax.model.delo import Model, Surfaces
from delo_jax.pipeline.local_map import LocalMap, Surroundings, surfaces_of
from delo_jax.uncertainty import covariance, status, stream
from delo_jax.uncertainty.observability import observability

NUM_LEARNED_POINTS = 512  # the robust steps take all
ROBUST_STEPS, SWEEP_STEPS = 4, 2  # between two searches for matches
SCALE_M, REACH_M = 0.1, 0.8
SWEEP_OPTIONS: dict[str, Any] = {
    "scale_m": SCALE_M,
    "reach_m": REACH_M,
    "num_steps": SWEEP_STEPS,
    "sigma_velocity": (0.5, 0.5),  # of that at the stamp, about the mean since the last scan [rad/s, m/s]
    "sigma_m": 0.002,  # of the mean plane distance of a scan
}
SETTLED = np.repeat([0.05, 0.15], 3)  # change of the velocity that needs no other round [rad/s, m/s]
MAX_ROUNDS = 5
UNSTEADY = np.repeat([0.35, 2.0], 3)  # change of the velocity, by which it is not constant within a sweep either [rad/s, m/s]
RECOVERY_STEPS = 12
INSERT_M, INSERT_DEG = 1.0, 5.0  # motion since the last insertion
NUM_RECENT = 20  # scans whose scores say what is usual
MIN_USUAL_SCORE = 0.35
SIGMA_M, NUM_INDEPENDENT = 0.02, 100.0  # of a plane distance; as many of them as if they were independent; `stream` has a share of that


@dataclasses.dataclass(frozen=True, kw_only=True)
class Steps:
    """How a scan is registered; other numbers are for comparison."""

    num_learned: int = 2
    """Learned steps from a prediction; where it may be far off, 12."""
    num_rounds: int = 1
    """Searches for matches after them, each with four classical steps."""
    deskew_again: bool = True
    """After the solve, solve once more with the velocity of the sweep free, where points carry times."""

    def __post_init__(self):
        for name in ("num_learned", "num_rounds"):
            require(getattr(self, name) >= 0, f"steps.{name}", "0 or more", getattr(self, name))


class MapFix(NamedTuple):
    """A scan registered to the map."""

    T_start_lidar: np.ndarray  # (4, 4) float64: where the sensor is, seen from the start
    score: float  # mean robust weight of the scan's points, in [0, 1]
    rms_m: float  # weighted distance to the surfaces
    information: np.ndarray  # (6, 6), right perturbation, per unit of weight


NOWHERE = MapFix(np.eye(4), 0.0, np.inf, np.zeros((6, 6)))


class SweepFix(NamedTuple):
    """A sweep registered with its velocity."""

    fix: MapFix
    scan: PreparedScan  # de-skewed with the velocity found
    change: np.ndarray  # (6,) of the velocity found from the one expected


class Located(NamedTuple):
    """Where a scan is."""

    motion: Estimate  # T_since_current; the covariance is the registration's own, of the pose on the map
    noise: stream.OnMap | None  # calibrated; None where the weights are not, or nothing was found
    swing: stream.Swing  # with this motion
    scan: PreparedScan  # as it was registered: de-skewed with this motion
    score: float  # as of its fix


def register(
    params: Model, scan: PreparedScan, near: Surroundings, T_start_init: np.ndarray, *, num_learned: int, num_rounds: int, skip: int = 0
) -> MapFix:
    """Pose of a scan near a start; score 0 where there is no map, or no number comes out.

    Args:
        params: weights.
        scan: to register.
        near: the map around the start.
        T_start_init: (4, 4) where to begin.
        num_learned: steps of the fine stage, on 512 points.
        num_rounds: searches for matches after them, each with four classical steps on all points.
        skip: points that the learned steps leave out: another subset is another chance.
    """
    T = T_start_init.astype(np.float32)
    if not near.usable:
        return NOWHERE
    first = min(skip, max(scan.num_points - NUM_LEARNED_POINTS, 0))
    source, rows, fix = surfaces_of(scan.scan), slice(first, first + NUM_LEARNED_POINTS), NOWHERE
    some = surfaces_of(scan.scan, rows)
    for _ in range(num_learned):
        T = np.asarray(inference.fine_step(params, some, near.matches(source, T, rows), T))
        if not np.isfinite(T).all():
            return NOWHERE
    for num_steps in [ROBUST_STEPS] * num_rounds or [0]:
        fit = _robust(source, near.planes_in_reach(source, T), T, num_steps)
        fix, T = _fix_of(fit), np.asarray(fit.T_target_source)
        if fix is NOWHERE:
            break
    return fix


def _fix_of(fit: RobustFit | SweepFit) -> MapFix:
    """On the host, orthonormal to float64; nowhere when it is not a number."""
    T = np.asarray(fit.T_target_source, np.float64)
    if not (np.isfinite(T).all() and np.isfinite(fit.information).all()):
        return NOWHERE
    return MapFix(se3.orthonormal(T), float(fit.score), float(fit.rms_m), np.asarray(fit.information, np.float64))


def register_sweep(scan: PreparedScan, near: Surroundings, fix: MapFix, velocity: np.ndarray) -> SweepFix:
    """A sweep registered once more, its velocity solved for with its pose; de-skewed anew as long as the velocity still changes.

    Args:
        scan: with times.
        near: the map that it was registered to.
        fix: where it is, de-skewed with another velocity.
        velocity: (6,) expected, [omega rad/s, v m/s].
    """
    found = velocity
    for _ in range(MAX_ROUNDS):
        scan = scan.still(found)
        fit = _sweep(scan, near, fix.T_start_lidar.astype(np.float32), velocity - found)
        refined = _fix_of(fit)
        if refined is NOWHERE or not np.isfinite(fit.velocity).all():
            break
        fix, found = refined, found + fit.velocity
        if np.all(np.abs(fit.velocity) < SETTLED):
            break
    return SweepFix(fix, scan.still(found), found - velocity)


def _sweep(scan: PreparedScan, near: Surroundings, T: np.ndarray, velocity_prior: np.ndarray) -> SweepFit:
    source = surfaces_of(scan.scan)
    rows = source.points, source.normals, source.mask, scan.times_s, *near.planes_in_reach(source, T)
    return jax.device_get(inference.sweep_steps(*rows, T, velocity_prior.astype(np.float32), **SWEEP_OPTIONS))


def _robust(source: Surfaces, planes: tuple[np.ndarray, np.ndarray], T: np.ndarray, num_steps: int) -> RobustFit:
    rows = source.points, source.normals, source.mask, *planes
    return jax.device_get(inference.robust_steps(*rows, T, scale_m=SCALE_M, reach_m=REACH_M, num_steps=num_steps))


def require_fine_stage(params: Model) -> None:
    """Raise where the network cannot register to a map."""
    if params.cfg.fine.num_iters == 0:
        name = params.cfg.name
        what = f"expected a network with a fine stage, got preset {name!r}, which has none; go without a map: use_map=False, --map none"
        raise ConfigError(f"map: {what}")


class MapTracker:
    """The local map of a drive, how well scans have fitted it lately, and what that says of the next one."""

    def __init__(self, params: Model, steps: Steps, stamp_sigma_s: float = 0.0):
        require_fine_stage(params)
        self._params, self._steps, self._map = params, steps, LocalMap()
        self._scores: deque[float] = deque(maxlen=NUM_RECENT)
        self._inserted_at: np.ndarray | None = None
        self._numbers, self._swing = stream.StreamNoise.of(params.variables), stream.STEADY
        self._stamp_sigma_s = stamp_sigma_s
        self._expected: tuple[np.ndarray, Surroundings] | None = None

    @property
    def calibrated(self) -> bool:
        """Whether the weights say what a pose on the map is off by."""
        return self._numbers is not None

    def restart(self, scan: PreparedScan, T_world_lidar: np.ndarray) -> None:
        """A new map that begins with this scan."""
        self._map, self._inserted_at, self._swing, self._expected = LocalMap(), None, stream.STEADY, None
        self._scores.clear()
        self.insert(scan, T_world_lidar)

    def expect(self, T_world_lidar: np.ndarray) -> None:
        """The next scan is expected here: the tree of the map around it grows while the scan is prepared."""
        self._expected = T_world_lidar, Surroundings(self._map, T_world_lidar, REACH_M)

    def _around(self, T_world_lidar: np.ndarray) -> Surroundings:
        if self._expected is not None and np.array_equal(self._expected[0], T_world_lidar):
            return self._expected[1]
        return Surroundings(self._map, T_world_lidar, REACH_M)

    def insert(self, scan: PreparedScan, T_world_lidar: np.ndarray) -> bool:
        """Take in a scan, once a metre or so; whether it was taken in."""
        if self._inserted_at is not None and se3.is_within(self._inserted_at, T_world_lidar, INSERT_M, INSERT_DEG):
            return False
        self._expected = None
        self._map.insert(surfaces_of(scan.scan), T_world_lidar)
        self._map.prune(T_world_lidar)
        self._inserted_at = T_world_lidar
        return True

    def locate(
        self, scan: PreparedScan, T_world_since: np.ndarray, Ts_since_guess: Sequence[np.ndarray], elapsed_s: float, *, recovering: bool
    ) -> Located:
        """Motion T_since_current of a scan, from guesses of it; the first guess itself when the scan does not fit the map.

        Args:
            scan: the new scan.
            T_world_since: pose that the motion starts from.
            Ts_since_guess: where to look; the one that the scan fits best from stands.
            elapsed_s: since then, for the velocity that the scan is de-skewed with again.
            recovering: the guesses may be far off: more learned steps, from two subsets of the scan's points, each de-skewed as it is
                and with the velocity of the guess.
        """
        num_learned = RECOVERY_STEPS if recovering and self._steps.num_learned else self._steps.num_learned
        skips = (0, NUM_LEARNED_POINTS) if recovering and num_learned else (0,)
        tries = []
        for T_since_guess in Ts_since_guess:
            near, sweeps = self._around(T_world_since @ T_since_guess), [scan]
            if recovering and scan.times_s is not None:  # a guess is a velocity too, unless the sensor was carried
                sweeps.append(scan.still(se3.log(T_since_guess) / elapsed_s))
            for sweep, skip in itertools.product(sweeps, skips):
                steps = {"num_learned": num_learned, "num_rounds": self._steps.num_rounds, "skip": skip}
                tries.append((register(self._params, sweep, near, np.eye(4), **steps), T_since_guess, near, sweep))
        fix, T_since_guess, near, scan = max(tries, key=lambda one: one[0].score)
        change = np.zeros(6)
        if self._steps.deskew_again and scan.times_s is not None and fix.score > 0.0:
            motions = [T_since_guess @ fix.T_start_lidar, *(Ts_since_guess if recovering else ())]
            fixes = [register_sweep(scan, near, fix, se3.log(T) / elapsed_s) for T in motions]
            fix, scan, change = max(fixes, key=lambda one: one.fix.score)
        motion = self._judged(scan, fix, Ts_since_guess[0], T_since_guess)
        if motion.status == "ok" and np.any(np.abs(change) > UNSTEADY):
            what = f"{np.degrees(np.abs(change[:3]).max()):.0f} deg/s and {np.abs(change[3:]).max():.1f} m/s"
            motion = dataclasses.replace(motion, status="low_confidence", reason=f"the velocity changed by {what} since the last scan")
        velocity = se3.log(motion.T_target_source) / elapsed_s
        swing = self._swing.after(velocity) if scan.times_s is not None else stream.STEADY
        return Located(motion, self._noise(motion, fix, velocity, swing.squares), swing, scan, fix.score)

    def accept(self, located: Located) -> None:
        """A scan stands where it was located; its score is one of the usual from now on."""
        self._scores.append(located.score)
        self._swing = located.swing

    def _judged(self, scan: PreparedScan, fix: MapFix, T_expected: np.ndarray, T_since_guess: np.ndarray) -> Estimate:
        """Motion, covariance and status of a fix."""
        cfg = self._params.cfg.status
        usual = max(float(np.median(self._scores)) if self._scores else 0.0, MIN_USUAL_SCORE)
        confidence = float(np.clip(2.5 * fix.score / usual - 0.7, 0.0, 1.0))  # 0.8 at 0.6 of the usual score, 0.2 at 0.36
        seen = observability(fix.information)
        usable = (scan.num_points, max(len(self._map), cfg.min_points))
        health = status.judge(num_points=usable, finite=fix.score > 0.0, confidence=confidence, seen=seen, cfg=cfg)
        lost = health.status == "rejected"
        T, known = (T_expected, covariance.unknown(cfg)) if lost else (T_since_guess @ fix.T_start_lidar, _classical(fix))
        if health.status == "degenerate":
            known = covariance.widen(known, seen, cfg)
        return Estimate(T_target_source=T, **known._asdict(), status=health.status, confidence=health.confidence, reason=health.reason)

    def _noise(self, motion: Estimate, fix: MapFix, velocity: np.ndarray, squares: np.ndarray) -> stream.OnMap | None:
        """Calibrated; with what the sensor may have moved by between the stamp and the scan.

        What was added along directions that nothing holds is not known of the map either.
        """
        if self._numbers is None or motion.status == "rejected":
            return None
        classical, way_m = _classical(fix).covariance, float(np.linalg.norm(motion.T_target_source[:3, 3]))
        noise = stream.noise_on_map(self._numbers, classical, squares, way_m)
        moved = self._stamp_sigma_s**2 * np.outer(velocity, velocity)
        return noise._replace(local=noise.local + moved, step=noise.step + motion.covariance - classical)


def _classical(fix: MapFix) -> covariance.Uncertainty:
    return covariance.from_information(fix.information, sigma_m=SIGMA_M + fix.rms_m, num_planes=fix.score * NUM_INDEPENDENT)
