"""The checks that every metric makes of the poses it is given."""

import numpy as np
from jaxtyping import Bool, Float64

from delo_jax.errors import DeloError


def checked_pair(Ts_estimated: np.ndarray, Ts_true: np.ndarray) -> tuple[Float64[np.ndarray, "n 4 4"], Float64[np.ndarray, "n 4 4"]]:
    """Both batches as float64, of one length and finite.

    Raises:
        DeloError: wrong shape, unequal lengths, NaN or infinity, a matrix that is no pose.
    """
    estimated, true = _checked(Ts_estimated, "Ts_estimated"), _checked(Ts_true, "Ts_true")
    if len(estimated) != len(true):
        raise DeloError(f"Ts_estimated: expected as many poses as Ts_true ({len(true)}), got {len(estimated)}; cut both to the same frames")
    return estimated, true


def _checked(Ts: np.ndarray, name: str) -> Float64[np.ndarray, "n 4 4"]:
    Ts = np.asarray(Ts, dtype=np.float64)
    if Ts.ndim != 3 or Ts.shape[1:] != (4, 4):
        raise DeloError(f"{name}: expected shape (n, 4, 4), got {Ts.shape}")
    _require_all(np.isfinite(Ts).all(axis=(1, 2)), name, "finite poses", "NaN or infinity")
    # loose: published trajectories are not quite orthonormal
    _require_all(np.abs(np.linalg.det(Ts[:, :3, :3]) - 1.0) < 0.1, name, "rotations of determinant 1", "no rotation")
    return Ts


def _require_all(good: Bool[np.ndarray, " n"], name: str, expected: str, got: str) -> None:
    if not good.all():
        raise DeloError(f"{name}: expected {expected}, got {got} in {np.sum(~good)} of {len(good)}, first at {np.argmin(good)}")
