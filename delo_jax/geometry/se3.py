"""Rigid poses as 4x4 matrices.

Conventions, here and everywhere in the package: twists and covariances are ordered `[omega (rad), v (m)]` and
perturb a pose from the right, `T exp(xi^)`, that is, in the body frame. One implementation serves NumPy (float64 on
the host) and JAX (inside jit); leading dimensions batch where the annotation shows `*b`. One pose alone on the host
goes a shorter way through `exp` and `log`: there every call of a NumPy function counts.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

full_float32 = jax.default_matmul_precision("highest")  # no TF32 on metres

AnyArray = jax.Array | np.ndarray

# Below this squared angle the closed forms cancel; five terms of the series are exact there in float64.
_SMALL = 1e-3
_SERIES = [[(-1) ** k / math.factorial(2 * k + n) for k in range(5)] for n in (1, 2, 3)]  # of `_rotation_coefficients`
_ARCTAN_SERIES = [(-1) ** k / (2 * k + 1) for k in range(5)]  # arctan(x) / x by x^2
_LOG_SERIES = [1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160]  # (1 - theta / 2 cot(theta / 2)) / theta^2 by theta^2


def _namespace(x):
    """`numpy` for NumPy arrays, `jax.numpy` for the rest."""
    return np if isinstance(x, np.ndarray) else jnp


def _polynomial(x, coefficients):
    """Sum of `coefficients[k] x^k`."""
    value = coefficients[-1] + 0.0 * x
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value


def _assemble(R, t):
    """4x4 poses from rotations (*b, 3, 3) and translations (*b, 3)."""
    xp = _namespace(R)
    top = xp.concatenate([R, t[..., None]], axis=-1)
    bottom = xp.zeros_like(top[..., :1, :]) + xp.asarray([0, 0, 0, 1], dtype=R.dtype).reshape((1,) * (R.ndim - 1) + (4,))
    return xp.concatenate([top, bottom], axis=-2)


def _rotation_coefficients(theta2):
    """sin(theta)/theta, (1 - cos(theta))/theta^2 and (theta - sin(theta))/theta^3, finite and smooth at 0."""
    xp = _namespace(theta2)
    small = theta2 < _SMALL
    if xp is np and small.all():  # one product: on the host, a pass over a few numbers costs as much as one over a thousand
        powers = np.vander(theta2.ravel(), 5, increasing=True)
        return tuple((np.array(_SERIES) @ powers.T).astype(theta2.dtype).reshape(3, *theta2.shape))
    series = (_polynomial(theta2, coefficients) for coefficients in _SERIES)
    theta = xp.sqrt(xp.where(small, 1.0, theta2))
    closed = (
        xp.sin(theta) / theta,
        0.5 * (xp.sin(0.5 * theta) / (0.5 * theta)) ** 2,
        (theta - xp.sin(theta)) / theta**3,
    )
    return tuple(xp.where(small, *values) for values in zip(series, closed, strict=True))


def skew(v: Float[AnyArray, "*b 3"]) -> Float[AnyArray, "*b 3 3"]:
    """Matrix with `skew(v) @ u = cross(v, u)`."""
    xp = _namespace(v)
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    zero = xp.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


@full_float32
def exp(xi: Float[AnyArray, "*b 6"]) -> Float[AnyArray, "*b 4 4"]:
    """Pose reached by following the twist `xi = [omega, v]` for unit time; smooth at zero."""
    xp = _namespace(xi)
    if isinstance(xi, np.ndarray) and xi.ndim == 1:
        return _exp_of_one(xi)
    omega, v = xi[..., :3], xi[..., 3:]
    a, b, c = _rotation_coefficients(xp.sum(omega * omega, axis=-1)[..., None, None])
    W = skew(omega)
    WW = W @ W
    eye = xp.zeros_like(W) + xp.eye(3, dtype=xi.dtype).reshape((1,) * (W.ndim - 2) + (3, 3))
    V = eye + b * W + c * WW
    return _assemble(eye + a * W + b * WW, (V @ v[..., None])[..., 0])


def _exp_of_one(xi: np.ndarray) -> np.ndarray:
    """The same of one twist on the host; what are numbers here would be arrays of one element, at ten times the cost."""
    x, y, z = xi[:3].tolist()
    theta2 = x * x + y * y + z * z
    theta = math.sqrt(theta2)
    if theta2 < _SMALL:
        a, b, c = (_polynomial(theta2, coefficients) for coefficients in _SERIES)
    else:
        a, b, c = math.sin(theta) / theta, 2.0 * (math.sin(0.5 * theta) / theta) ** 2, (theta - math.sin(theta)) / theta**3
    T, W, v = np.eye(4, dtype=xi.dtype), np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], xi.dtype), xi[3:]
    Wv = W @ v
    T[:3, :3] += a * W + b * (W @ W)
    T[:3, 3] = v + b * Wv + c * (W @ Wv)
    return T


def exp_along(xi: Float[np.ndarray, "6"], times: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
    """Poses reached by following one twist for each of these times, `exp(times[k] * xi)`; on the host."""
    (x, y, z), v = xi[:3].tolist(), xi[3:]
    W, squares = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], xi.dtype), times * times
    a, b, c = _rotation_coefficients(squares * (x * x + y * y + z * z))
    weights = np.array([np.ones_like(times), times, a * times, b * squares, c * squares * times]).T
    parts = np.zeros((5, 4, 4), xi.dtype)
    parts[0], parts[1, :3, 3] = np.eye(4), v
    parts[2, :3, :3], parts[3, :3, :3] = W, W @ W
    parts[3, :3, 3], parts[4, :3, 3] = W @ v, W @ (W @ v)
    return (weights @ parts.reshape(5, 16)).reshape(-1, 4, 4)


def _rotation_log(R):
    """Rotation vector (*b, 3) of R, by way of the quaternion.

    Each row of 4 q q^T is a linear function of R and a multiple of q; the row with the largest diagonal is well
    conditioned at every angle. Near the identity its vector part is vee(R), so that the angle is an atan2 of
    |vee(R)| and the trace: no arccos, which in float32 loses all angles below 0.02 deg.
    """
    xp = _namespace(R)
    r = [[R[..., i, j] for j in range(3)] for i in range(3)]
    wx, wy, wz = r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]
    xy, xz, yz = r[0][1] + r[1][0], r[0][2] + r[2][0], r[1][2] + r[2][1]
    ww = 1.0 + r[0][0] + r[1][1] + r[2][2]
    xx = 1.0 + r[0][0] - r[1][1] - r[2][2]
    yy = 1.0 - r[0][0] + r[1][1] - r[2][2]
    zz = 1.0 - r[0][0] - r[1][1] + r[2][2]
    rows = [[ww, wx, wy, wz], [wx, xx, xy, xz], [wy, xy, yy, yz], [wz, xz, yz, zz]]
    outer = xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)
    largest = xp.argmax(xp.stack([ww, xx, yy, zz], axis=-1), axis=-1)[..., None, None]
    q = xp.take_along_axis(outer, largest, axis=-2)[..., 0, :]
    q = xp.where(q[..., :1] < 0, -q, q)  # angle in [0, pi]
    w, vector = q[..., :1], q[..., 1:]
    norm2 = xp.sum(vector * vector, axis=-1, keepdims=True)
    small = norm2 < _SMALL * w * w
    safe_w = xp.where(small, w, 1.0)
    norm = xp.sqrt(xp.where(small, 1.0, norm2))
    series = _polynomial(norm2 / safe_w**2, _ARCTAN_SERIES) / safe_w
    return 2.0 * vector * xp.where(small, series, xp.arctan2(norm, w) / norm)


@full_float32
def log(T: Float[AnyArray, "*b 4 4"]) -> Float[AnyArray, "*b 6"]:
    """Twist `[omega, v]` with `exp(xi) = T`, |omega| <= pi; smooth at the identity, stable near pi."""
    xp = _namespace(T)
    if isinstance(T, np.ndarray) and T.ndim == 2:
        return _log_of_one(T)
    omega = _rotation_log(T[..., :3, :3])
    theta2 = xp.sum(omega * omega, axis=-1)[..., None, None]
    a, b, _ = _rotation_coefficients(theta2)
    small = theta2 < _SMALL
    series = _polynomial(theta2, _LOG_SERIES)
    d = xp.where(small, series, (1.0 - 0.5 * a / b) / xp.where(small, 1.0, theta2))
    W = skew(omega)
    t = T[..., :3, 3:]
    Wt = W @ t
    return xp.concatenate([omega, (t - 0.5 * Wt + d * (W @ Wt))[..., 0]], axis=-1)


def _log_of_one(T: np.ndarray) -> np.ndarray:
    """The same of one pose on the host."""
    (xx, xy, xz, tx), (yx, yy, yz, ty), (zx, zy, zz, tz) = T[:3].tolist()
    rows = (
        (1.0 + xx + yy + zz, zy - yz, xz - zx, yx - xy),
        (zy - yz, 1.0 + xx - yy - zz, xy + yx, xz + zx),
        (xz - zx, xy + yx, 1.0 - xx + yy - zz, yz + zy),
        (yx - xy, xz + zx, yz + zy, 1.0 - xx - yy + zz),
    )
    w, x, y, z = rows[max(range(4), key=lambda k: rows[k][k])]
    norm2 = x * x + y * y + z * z
    if norm2 < _SMALL * w * w:
        scale = 2.0 * _polynomial(norm2 / (w * w), _ARCTAN_SERIES) / w
    else:
        norm = math.sqrt(norm2)
        scale = 2.0 * math.atan2(norm, abs(w)) / math.copysign(norm, w)  # of q and -q the one with an angle in [0, pi]
    x, y, z = scale * x, scale * y, scale * z
    theta2 = x * x + y * y + z * z
    half = 0.5 * math.sqrt(theta2)
    d = _polynomial(theta2, _LOG_SERIES) if theta2 < _SMALL else (1.0 - half / math.tan(half)) / theta2
    ux, uy, uz = y * tz - z * ty, z * tx - x * tz, x * ty - y * tx
    v = [
        tx - 0.5 * ux + d * (y * uz - z * uy),
        ty - 0.5 * uy + d * (z * ux - x * uz),
        tz - 0.5 * uz + d * (x * uy - y * ux),
    ]
    return np.array([x, y, z, *v], T.dtype)


@full_float32
def orthonormal(T: Float[AnyArray, "*b 4 4"]) -> Float[AnyArray, "*b 4 4"]:
    """The pose with the rotation that is nearest to that of T, which rounding has left a little off."""
    u, _, vt = _namespace(T).linalg.svd(T[..., :3, :3])
    return _assemble(u @ vt, T[..., :3, 3])


@full_float32
def inverse(T: Float[AnyArray, "*b 4 4"]) -> Float[AnyArray, "*b 4 4"]:
    """T_a_b from T_b_a."""
    R_inverse = _namespace(T).swapaxes(T[..., :3, :3], -1, -2)
    return _assemble(R_inverse, -(R_inverse @ T[..., :3, 3:])[..., 0])


@full_float32
def adjoint(T: Float[AnyArray, "*b 4 4"]) -> Float[AnyArray, "*b 6 6"]:
    """Matrix with `T exp(xi) T^-1 = exp(adjoint(T) xi)`, order `[omega, v]`."""
    xp = _namespace(T)
    R = T[..., :3, :3]
    top = xp.concatenate([R, xp.zeros_like(R)], axis=-1)
    bottom = xp.concatenate([skew(T[..., :3, 3]) @ R, R], axis=-1)
    return xp.concatenate([top, bottom], axis=-2)


@full_float32
def transform(T: Float[AnyArray, "4 4"], points: Float[AnyArray, "n 3"]) -> Float[AnyArray, "n 3"]:
    """Points [m] of frame b in frame a, given T_a_b."""
    return points @ T[:3, :3].T + T[None, :3, 3]


def pose6(T: Float[AnyArray, "4 4"]) -> Float[AnyArray, " 6"]:
    """`[roll, pitch, yaw, x, y, z]` with R = Rx(roll) Ry(pitch) Rz(yaw) (intrinsic XYZ), rad and m.

    Not a twist. Roll and yaw are not separable at a pitch of +-90 deg.
    """
    xp = _namespace(T)
    roll = xp.arctan2(-T[1, 2], T[2, 2])
    pitch = xp.arctan2(T[0, 2], xp.sqrt(T[0, 0] ** 2 + T[0, 1] ** 2))
    yaw = xp.arctan2(-T[0, 1], T[0, 0])
    return xp.concatenate([xp.stack([roll, pitch, yaw]), T[:3, 3]])


@full_float32
def from_pose6(pose: Float[AnyArray, " 6"]) -> Float[AnyArray, "4 4"]:
    """Pose of `[roll, pitch, yaw, x, y, z]`, the inverse of `pose6`."""
    xp = _namespace(pose)
    (cx, cy, cz), (sx, sy, sz) = xp.cos(pose[:3]), xp.sin(pose[:3])
    zero, one = xp.zeros_like(cx), xp.ones_like(cx)
    Rx = xp.stack([xp.stack([one, zero, zero]), xp.stack([zero, cx, -sx]), xp.stack([zero, sx, cx])])
    Ry = xp.stack([xp.stack([cy, zero, sy]), xp.stack([zero, one, zero]), xp.stack([-sy, zero, cy])])
    Rz = xp.stack([xp.stack([cz, -sz, zero]), xp.stack([sz, cz, zero]), xp.stack([zero, zero, one])])
    return _assemble(Rx @ Ry @ Rz, pose[3:])


@full_float32
def pose6_jacobian(pose: Float[AnyArray, " 6"]) -> Float[AnyArray, "6 6"]:
    """Right perturbation `[omega, v]` of a pose per change of its `pose6`: log(T^-1 from_pose6(pose + d)) = J d, to first order.

    T is `from_pose6(pose)`. The columns of the angles are the three axes as the body sees them: x of the reference frame for the
    roll, y turned by the yaw for the pitch, the body's own z for the yaw. At a pitch of +-90 deg the first and the last are parallel.
    """
    xp = _namespace(pose)
    R = from_pose6(pose)[:3, :3]
    cz, sz = xp.cos(pose[2]), xp.sin(pose[2])
    zero, one = xp.zeros_like(cz), xp.ones_like(cz)
    angles = xp.stack([R[0], xp.stack([sz, cz, zero]), xp.stack([zero, zero, one])], axis=1)
    zeros = xp.zeros_like(R)
    return xp.concatenate([xp.concatenate([angles, zeros], axis=1), xp.concatenate([zeros, R.T], axis=1)], axis=0)


@full_float32
def compose_covariance(
    covariance_a: Float[AnyArray, "6 6"], covariance_b: Float[AnyArray, "6 6"], T_b: Float[AnyArray, "4 4"]
) -> Float[AnyArray, "6 6"]:
    """Covariance of `T_a @ T_b`, to first order, for independent right perturbations of both.

    T_a exp(a) T_b exp(b) = T_a T_b exp(Ad(T_b^-1) a) exp(b): only T_b matters.
    """
    Ad = adjoint(inverse(T_b))
    return Ad @ covariance_a @ Ad.T + covariance_b


@full_float32
def invert_covariance(covariance: Float[AnyArray, "6 6"], T: Float[AnyArray, "4 4"]) -> Float[AnyArray, "6 6"]:
    """Covariance of `inverse(T)` from that of T: (T exp(xi))^-1 = T^-1 exp(-Ad(T) xi)."""
    Ad = adjoint(T)
    return Ad @ covariance @ Ad.T


def to_ros_covariance(covariance: Float[AnyArray, "6 6"]) -> Float[AnyArray, " 36"]:
    """The 36 row-major numbers of a ROS pose message, order x, y, z, roll, pitch, yaw.

    Only the order changes: it stays the covariance of the same right perturbation, so its axes are those of the body.
    """
    order = np.array([3, 4, 5, 0, 1, 2])
    return covariance[order][:, order].reshape(36)


def rotation_angle(R: Float[AnyArray, "*b 3 3"]) -> Float[AnyArray, "*b"]:
    """Angle of a rotation in [0, pi] rad, as an atan2, exact for small angles; its gradient at 0 is 0."""
    xp = _namespace(R)
    sin2 = (R[..., 2, 1] - R[..., 1, 2]) ** 2 + (R[..., 0, 2] - R[..., 2, 0]) ** 2 + (R[..., 1, 0] - R[..., 0, 1]) ** 2
    positive = sin2 > 0
    twice_sin = xp.where(positive, xp.sqrt(xp.where(positive, sin2, 1.0)), 0.0)
    return xp.asarray(xp.arctan2(twice_sin, R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1.0))


def is_within(T_a: Float[np.ndarray, "4 4"], T_b: Float[np.ndarray, "4 4"], distance_m: float, angle_deg: float) -> bool:
    """Whether two poses are nearer to each other than a distance and an angle; on the host."""
    apart = inverse(T_a) @ T_b
    return bool(np.linalg.norm(apart[:3, 3]) < distance_m and rotation_angle(apart[:3, :3]) < np.radians(angle_deg))
