"""Poses, twists and their covariances."""

import gtsam
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from delo_jax.geometry import se3
from tests.oracles.agreement import assert_gradient_is_the_slope, assert_transforms_agree
from tests.oracles.registration import hat, numeric_jacobian

ANGLES = [0.0, 1e-12, 1e-7, 1e-4, 0.031, 0.032, 0.5, 3.0, np.pi - 1e-4, np.pi - 1e-9]

jitted_exp, jitted_log = jax.jit(se3.exp), jax.jit(se3.log)


def twists(angle, count=4, seed=0):
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(count, 3))
    return np.hstack([angle * axes / np.linalg.norm(axes, axis=1, keepdims=True), 10 * rng.normal(size=(count, 3))])


def random_pose(seed):
    return gtsam.Pose3.Expmap(np.random.default_rng(seed).normal(size=6)).matrix()


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_the_matrix_exponential(angle):
    """Oracle: scipy.linalg.expm of the 4x4 matrix of the twist, and gtsam Pose3.Expmap for the order [omega, v]."""
    xi = twists(angle)
    T = se3.exp(xi)
    assert T.dtype == np.float64
    np.testing.assert_allclose(T, [expm(hat(x)) for x in xi], atol=5e-13)
    np.testing.assert_allclose(T, [gtsam.Pose3.Expmap(x).matrix() for x in xi], atol=1e-11)
    np.testing.assert_allclose([se3.exp(x) for x in xi], [expm(hat(x)) for x in xi], atol=5e-13)
    assert se3.exp(xi[0].astype(np.float32)).dtype == se3.exp(xi.astype(np.float32)).dtype == np.float32


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_along_a_twist_is_the_matrix_exponential(angle):
    """Oracle: scipy.linalg.expm of the twist times each time, before and after 0."""
    times = np.linspace(-1.0, 0.5, 7)
    for xi in twists(angle):
        np.testing.assert_allclose(se3.exp_along(xi, times), [expm(hat(t * xi)) for t in times], atol=5e-13)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_inverts_the_matrix_exponential_up_to_pi(angle):
    """Oracle: the twist that scipy's expm was given; no angle below pi is special, that of a half turn included."""
    xi = twists(angle)
    Ts = np.stack([expm(hat(x)) for x in xi])
    np.testing.assert_allclose(se3.log(Ts), xi, atol=1e-11)
    np.testing.assert_allclose([se3.log(T) for T in Ts], xi, atol=1e-11)
    assert se3.log(Ts[0].astype(np.float32)).dtype == np.float32


def test_log_of_half_turns():
    """Oracle: scipy Rotation; at pi the axis is known up to its sign."""
    for axis in [*np.eye(3), np.array([0.6, 0.0, -0.8]), np.ones(3) / np.sqrt(3)]:
        T = np.eye(4)
        T[:3, :3] = 2 * np.outer(axis, axis) - np.eye(3)
        for omega in (se3.log(T)[:3], se3.log(T[None])[0, :3]):
            np.testing.assert_allclose(Rotation.from_rotvec(omega).as_matrix(), T[:3, :3], atol=1e-14)
            assert np.linalg.norm(omega) == pytest.approx(np.pi)


def test_log_of_no_number_is_none():
    """Oracle: a pose of which nothing is known, alone and with others."""
    T = np.full((4, 4), np.nan)
    assert np.isnan(se3.log(T)).all()
    assert np.isnan(se3.log(T[None])).all()


@given(arrays(np.float64, 6, elements=st.floats(-1.5, 1.5)))
def test_float32_on_jax_follows_jaxlie(xi):
    """Oracle: jaxlie, translation first, evaluated in the same float32."""
    T = jitted_exp(jnp.asarray(xi, jnp.float32))
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        other = jaxlie.SE3.exp(jnp.asarray(np.r_[xi[3:], xi[:3]], jnp.float32))
        np.testing.assert_allclose(T, other.as_matrix(), atol=2e-6)
    np.testing.assert_allclose(jitted_log(T), xi, atol=1e-5)


@pytest.mark.parametrize("angle_deg", [1e-4, 1e-3, 0.02])
def test_float32_keeps_tiny_angles(angle_deg):
    """Oracle: the angle put in; arccos of the trace would return 0 or 0.02 deg."""
    xi = twists(np.deg2rad(angle_deg)).astype(np.float32)
    T = jitted_exp(jnp.asarray(xi))
    np.testing.assert_allclose(np.rad2deg(jax.jit(se3.rotation_angle)(T[:, :3, :3])), angle_deg, rtol=2e-3)
    np.testing.assert_allclose(jitted_log(T)[:, :3], xi[:, :3], rtol=2e-3, atol=1e-9)


def test_numpy_and_jax_are_one_implementation():
    """Oracle: the NumPy side, tested above, against JAX in x64."""
    xi = np.concatenate([twists(angle) for angle in ANGLES])
    with jax.enable_x64(True):
        T = jitted_exp(jnp.asarray(xi))
        np.testing.assert_allclose(T, se3.exp(xi), atol=1e-14)
        np.testing.assert_allclose(jitted_log(T), xi, atol=1e-11)
        pose = se3.pose6(T[0])
        np.testing.assert_allclose(pose, se3.pose6(se3.exp(xi)[0]), atol=1e-14)
        np.testing.assert_allclose(se3.from_pose6(pose), T[0], atol=1e-14)
        np.testing.assert_allclose(se3.adjoint(T), se3.adjoint(se3.exp(xi)), atol=1e-12)


def test_jacobian_at_the_identity_and_near_it():
    """Oracle: central differences of scipy's expm; at zero autodiff of a naive norm is NaN."""
    with jax.enable_x64(True):
        jacobian = jax.jit(jax.jacfwd(se3.exp))
        for xi in (np.zeros(6), np.array([1e-9, 0, 0, 1.0, 2.0, 3.0]), twists(2.5)[0]):
            expected = numeric_jacobian(lambda x: expm(hat(x)).ravel(), xi, step=1e-5)
            np.testing.assert_allclose(jacobian(jnp.asarray(xi)).reshape(16, 6), expected, atol=1e-8)
        chain = jax.jit(jax.jacrev(lambda x: se3.log(se3.exp(x))))
        for xi in (np.zeros(6), twists(1e-9)[0], twists(2.5)[0]):  # the log of the exp is the identity map
            np.testing.assert_allclose(chain(jnp.asarray(xi)), np.eye(6), atol=1e-9)


def test_other_gradients_are_the_slopes():
    """Oracle: central differences in x64."""
    with jax.enable_x64(True):
        probe = jnp.arange(16.0).reshape(4, 4)

        def loss(xi):
            T = se3.exp(xi)
            points = se3.transform(T, probe[:, :3])
            loops = se3.from_pose6(2.0 * se3.pose6(se3.inverse(T)))
            return jnp.sum(points**2) + jnp.sum(probe * loops) + se3.rotation_angle(T[:3, :3]) + jnp.sum(se3.adjoint(T) ** 3)

        assert_gradient_is_the_slope(loss, [twists(0.8)[0] / 3])
        at_identity = jax.grad(lambda xi: se3.rotation_angle(se3.exp(xi)[:3, :3]))(jnp.zeros(6))
        np.testing.assert_array_equal(at_identity, np.zeros(6))


def test_exp_and_log_under_jit_and_vmap():
    """Oracle: the same function, one pose at a time, not compiled."""
    xi = jnp.asarray(twists(0.7), jnp.float32)
    assert_transforms_agree(lambda x: (se3.exp(x), se3.log(se3.exp(x)), se3.inverse(se3.exp(x))), xi)
    np.testing.assert_allclose(se3.exp(xi.reshape(2, 2, 6)).reshape(4, 4, 4), se3.exp(xi), atol=1e-6)


@pytest.mark.parametrize(("distance_m", "angle_deg", "within"), [(1.01, 5.1, True), (0.99, 5.1, False), (1.01, 4.9, False)])
def test_nearness_of_poses(distance_m, angle_deg, within):
    """Oracle: by hand: 1 m and 5 deg apart, wherever the first one is."""
    apart = np.eye(4)
    apart[:3, :3], apart[:3, 3] = Rotation.from_rotvec(np.radians([3.0, 0.0, 4.0])).as_matrix(), [0.6, 0.0, -0.8]
    T = random_pose(0)
    assert se3.is_within(T, T @ apart, distance_m, angle_deg) == within


@pytest.mark.parametrize("seed", range(3))
def test_group_operations(seed):
    """Oracle: gtsam Pose3 (inverse, AdjointMap, transformFrom), NumPy cross product."""
    rng = np.random.default_rng(seed)
    T, points = random_pose(seed), rng.normal(size=(5, 3))
    pose = gtsam.Pose3(T)
    np.testing.assert_allclose(se3.inverse(T), pose.inverse().matrix(), atol=1e-13)
    np.testing.assert_allclose(se3.adjoint(T), pose.AdjointMap(), atol=1e-13)
    np.testing.assert_allclose(se3.transform(T, points), pose.transformFrom(points.T).T, atol=1e-13)
    np.testing.assert_allclose(se3.skew(points) @ points[0], np.cross(points, points[:1]), atol=1e-14)
    np.testing.assert_allclose(se3.rotation_angle(T[:3, :3]), Rotation.from_matrix(T[:3, :3]).magnitude(), atol=1e-13)
    assert se3.transform(T, points[:0]).shape == (0, 3)


@pytest.mark.parametrize("seed", range(3))
def test_orthonormal_takes_rounding_out(seed):
    """Oracle: the pose before it was disturbed; translation is left alone."""
    T = random_pose(seed)
    disturbed = T.copy()
    disturbed[:3, :3] += 1e-6 * np.random.default_rng(seed).normal(size=(3, 3))
    found = se3.orthonormal(disturbed)
    np.testing.assert_allclose(found, T, atol=5e-6)
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-14)
    np.testing.assert_array_equal(found[:, 3], T[:, 3])


@pytest.mark.parametrize("seed", range(3))
def test_pose6_is_intrinsic_xyz(seed):
    """Oracle: scipy Rotation, upper-case "XYZ"."""
    T = random_pose(seed)
    pose = se3.pose6(T)
    np.testing.assert_allclose(pose, np.r_[Rotation.from_matrix(T[:3, :3]).as_euler("XYZ"), T[:3, 3]], atol=1e-13)
    np.testing.assert_allclose(se3.from_pose6(pose), T, atol=1e-13)


POSES6 = [
    np.zeros(6),
    np.array([0.1, -0.2, 0.3, 4.0, 5.0, -6.0]),
    np.array([-2.9, 1.4, 3.1, -20.0, 1.0, 0.5]),
    np.array([0.0, np.pi / 2, 0.7, 1.0, 2.0, 3.0]),
]


@pytest.mark.parametrize("pose", POSES6)
def test_jacobian_of_pose6_is_the_slope(pose):
    """Oracle: central differences of scipy Rotation's intrinsic XYZ and gtsam's Logmap; half turns and a pitch of 90 deg included."""

    def T(pose):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = Rotation.from_euler("XYZ", pose[:3]).as_matrix(), pose[3:]
        return matrix

    expected = numeric_jacobian(lambda moved: gtsam.Pose3.Logmap(gtsam.Pose3(np.linalg.inv(T(pose)) @ T(moved))), pose, step=1e-5)
    found = se3.pose6_jacobian(pose)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, expected, atol=1e-8)


def test_jacobian_of_pose6_under_jit_and_vmap():
    """Oracle: the same function, one pose at a time, not compiled; its gradient by central differences; NumPy, tested above."""
    poses = np.array(POSES6)
    assert_transforms_agree(se3.pose6_jacobian, jnp.asarray(poses, jnp.float32))
    with jax.enable_x64(True):
        np.testing.assert_allclose(se3.pose6_jacobian(jnp.asarray(poses[2])), se3.pose6_jacobian(poses[2]), atol=1e-14)
        probe = jnp.arange(36.0).reshape(6, 6)
        assert_gradient_is_the_slope(lambda pose: jnp.sum(probe * se3.pose6_jacobian(pose)), [poses[1]])


def test_covariances_follow_the_chain_rule():
    """Oracle: central differences of gtsam's compose, inverse and Logmap; right perturbations."""
    rng = np.random.default_rng(0)
    A, B = gtsam.Pose3(random_pose(1)), gtsam.Pose3(random_pose(2))
    covariance_a, covariance_b = (M @ M.T for M in rng.normal(size=(2, 6, 6)))

    def composed(x):
        moved = A.compose(gtsam.Pose3.Expmap(x[:6])).compose(B).compose(gtsam.Pose3.Expmap(x[6:]))
        return gtsam.Pose3.Logmap(A.compose(B).between(moved))

    J = numeric_jacobian(composed, np.zeros(12))
    expected = J[:, :6] @ covariance_a @ J[:, :6].T + J[:, 6:] @ covariance_b @ J[:, 6:].T
    np.testing.assert_allclose(se3.compose_covariance(covariance_a, covariance_b, B.matrix()), expected, rtol=1e-6, atol=1e-6)

    J = numeric_jacobian(lambda x: gtsam.Pose3.Logmap(A.compose(A.compose(gtsam.Pose3.Expmap(x)).inverse())), np.zeros(6))
    np.testing.assert_allclose(se3.invert_covariance(covariance_a, A.matrix()), J @ covariance_a @ J.T, rtol=1e-6, atol=1e-6)


def test_ros_order():
    """Oracle: the layout in geometry_msgs/PoseWithCovariance, written out for two entries."""
    covariance = np.arange(36.0).reshape(6, 6)
    ros = se3.to_ros_covariance(covariance)
    assert ros.shape == (36,)
    assert ros[0] == covariance[3, 3]  # x, x
    assert ros[1 * 6 + 5] == covariance[4, 2]  # y, yaw
    np.testing.assert_array_equal(se3.to_ros_covariance(jnp.asarray(covariance)), ros)
