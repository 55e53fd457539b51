"""`odometry(params, src, tgt)`: two scans in, a pose with covariance and status out. Holds the jitted encode and solve."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from delo_jax.errors import ScanError
from delo_jax.geometry import se3
from delo_jax.geometry.deskew import Sweep
from delo_jax.geometry.point_to_plane import robust_point_to_plane, robust_sweep_to_plane
from delo_jax.model import delo
from delo_jax.preprocess import Scan, check_points, preprocess_timed, still, sweep_of_scan
from delo_jax.uncertainty import covariance, status
from delo_jax.uncertainty.observability import observability

encode = jax.jit(delo.encode)
solve = jax.jit(delo.solve)
fine_step = jax.jit(delo.fine_step)
pair_covariance = jax.jit(delo.covariance)
robust_steps = jax.jit(robust_point_to_plane, static_argnames=("scale_m", "reach_m", "num_steps"))
sweep_steps = jax.jit(robust_sweep_to_plane, static_argnames=("scale_m", "reach_m", "num_steps", "sigma_velocity", "sigma_m"))


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Estimate:
    """Pose of a pair with its uncertainty and health.

    Variances and the covariance are those of `T_target_source` under a right perturbation, order [omega, v], rad and m.
    Those of a pair are fitted by `delo calibrate`; of weights that are not calibrated they are the evidence head's own, and a preset
    without one says that it knows nothing. Those of a scan on a map are fitted by `delo calibrate` on simulated drives
    (`uncertainty.stream`); of weights without these numbers they come from the information matrix of its last solve, not calibrated.
    """

    T_target_source: np.ndarray
    """(4, 4) float64: maps source points into the target frame."""
    covariance: np.ndarray
    """(6, 6); the evidence's own also holds the square of its expected error, which is not applied to the pose."""
    aleatoric: np.ndarray
    """(6,) variances: noise of the data."""
    epistemic: np.ndarray
    """(6,) variances: doubt of the model."""
    status: str
    """ok, low_confidence, degenerate or rejected."""
    confidence: float
    """In [0, 1]: the probability that a pair is not lost; with the paper's evidence head its 1 - Var[mu], which is none; of a scan
    on a map, how well it fits beside what is usual there."""
    reason: str
    """Why the status is not ok; empty when it is."""

    @classmethod
    def exact(cls, T_target_source: np.ndarray) -> "Estimate":
        """A pose that is known without error."""
        return cls(
            T_target_source=T_target_source,
            covariance=np.zeros((6, 6)),
            aleatoric=np.zeros(6),
            epistemic=np.zeros(6),
            status="ok",
            confidence=1.0,
            reason="",
        )

    def inverted(self) -> "Estimate":
        """The same estimate of the inverse pose, `T_source_target`, covariance carried through the adjoint."""
        squares = se3.adjoint(self.T_target_source) ** 2  # the head gives variances axis by axis
        return dataclasses.replace(
            self,
            T_target_source=se3.inverse(self.T_target_source),
            covariance=se3.invert_covariance(self.covariance, self.T_target_source),
            aleatoric=squares @ self.aleatoric,
            epistemic=squares @ self.epistemic,
        )


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PreparedScan:
    """A preprocessed scan; encoded when the network first asks for it, once for each de-skew."""

    params: delo.Model
    scan: Scan
    """NumPy arrays; de-skewed if it came from `still`."""
    measured: Scan
    """The same as measured by the moving sensor."""
    times_s: np.ndarray | None
    """(m,) of its points, relative to the stamp; None where the points carry none."""
    sweep: Sweep | None = None
    """The instants of these times; kept from the first de-skew on."""

    @functools.cached_property
    def num_points(self) -> int:
        """Usable points."""
        return int(self.scan.mask.sum())

    @functools.cached_property
    def encoding(self) -> delo.Encoding:
        """What the network keeps of it."""
        return encode(self.params, self.scan)

    def still(self, velocity: np.ndarray | None) -> "PreparedScan":
        """The scan de-skewed with a body velocity (6,) [omega rad/s, v m/s]; as measured where that or the times are not known."""
        if self.times_s is None or velocity is None:
            return self
        sweep = self.sweep or sweep_of_scan(self.measured, self.times_s)
        return dataclasses.replace(self, scan=still(self.measured, sweep, velocity), sweep=sweep)


def prepare(params: delo.Model, points: ArrayLike, times_s: np.ndarray | None = None) -> PreparedScan:
    """Preprocess a scan; the network encodes it when it first needs to.

    Args:
        params: weights.
        points: (n, 3) in the sensor frame, as measured [m].
        times_s: (n,) relative to the stamp, to de-skew the scan by later; None when there is nothing to de-skew.

    Raises:
        ScanError: not an array of numbers of shape (n, 3).
    """
    scan, times_s = preprocess_timed(check_points(points), times_s, params.cfg.preprocess)
    return PreparedScan(params=params, scan=scan, measured=scan, times_s=times_s)


def align(params: delo.Model, source: PreparedScan, target: PreparedScan, T_target_source_init: np.ndarray) -> Estimate:
    """Estimate of a pair of scans from a start; see `odometry`."""
    limits = params.cfg.status
    start = np.asarray(T_target_source_init, np.float64)
    solved = solve(params, source.encoding, target.encoding, jnp.asarray(start, jnp.float32))
    spread = pair_covariance(params, solved) if params.cfg.evidence.covariance_width else None
    result, spread = jax.device_get((solved, spread))
    seen = observability(result.information) if result.finite else observability(np.zeros((6, 6)))
    head = params.cfg.evidence.head
    health = status.judge(
        num_points=(source.num_points, target.num_points),
        finite=bool(result.finite),
        confidence=None if head == "none" else float(np.nan_to_num(result.confidence)),
        seen=seen,
        cfg=limits,
    )
    T, known = start, covariance.unknown(limits)
    if health.status != "rejected":
        nig = [np.asarray(value, np.float64) for value in result.nig]
        T = se3.orthonormal(np.asarray(result.T_target_source, np.float64))
        if spread is not None:
            known = covariance.from_half(np.asarray(spread.half, np.float64), float(spread.doubt))
        elif head == "statistics":
            known = covariance.from_evidence(*nig)
        elif head == "embedding":
            known = covariance.from_pose6_evidence(T, *nig)
    if health.status == "degenerate":
        known = covariance.widen(known, seen, limits)
    return Estimate(
        T_target_source=T,
        covariance=known.covariance,
        aleatoric=known.aleatoric,
        epistemic=known.epistemic,
        status=health.status,
        confidence=health.confidence,
        reason=health.reason,
    )


def odometry(params: delo.Model, src: ArrayLike, tgt: ArrayLike, *, T_target_source_init: ArrayLike | None = None) -> Estimate:
    """Relative pose of two scans, with no motion prior.

    Depends on its arguments alone: the same input gives the same bytes. The first call compiles (seconds).

    Args:
        params: weights, from `delo_jax.load`.
        src: (N, 3) source points [m], any N.
        tgt: (M, 3) target points [m], any M.
        T_target_source_init: optional start; used as a second hypothesis beside the network's own, and as the answer
            when the pair is rejected. The identity by default.

    Returns:
        Estimate of `T_target_source`. Too few points or a failed solve never raise: the status says `rejected`.

    Raises:
        ScanError: wrong shape or dtype of a scan or of the start.
    """
    start = np.eye(4) if T_target_source_init is None else check_pose(T_target_source_init)
    return align(params, prepare(params, src), prepare(params, tgt), start)


def check_pose(T: ArrayLike) -> np.ndarray:
    """A start as a (4, 4) float64 pose.

    Raises:
        ScanError: wrong shape, or not a rigid transformation.
    """
    try:
        pose = np.asarray(T, np.float64)
    except (TypeError, ValueError) as error:
        raise ScanError(f"T_target_source_init: expected a (4, 4) pose, got {error}") from error
    if pose.shape != (4, 4):
        raise ScanError(f"T_target_source_init: expected a (4, 4) pose, got shape {pose.shape}")
    R = pose[:3, :3]
    rigid = np.isfinite(pose).all() and np.allclose(R @ R.T, np.eye(3), atol=1e-4) and np.linalg.det(R) > 0
    if not rigid or not np.allclose(pose[3], [0, 0, 0, 1]):
        raise ScanError("T_target_source_init: expected a rigid transformation, got a rotation that is none or a last row not 0 0 0 1")
    return pose
