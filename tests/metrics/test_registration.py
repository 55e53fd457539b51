import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from delo_jax.errors import DeloError
from delo_jax.metrics._poses import checked_pair
from delo_jax.metrics.registration import pose_errors


def random_poses(seed, n, *, length_m=10.0):
    rng = np.random.default_rng(seed)
    Ts = np.tile(np.eye(4), (n, 1, 1))
    Ts[:, :3, :3] = Rotation.random(n, rng=rng).as_matrix()
    Ts[:, :3, 3] = length_m * rng.normal(size=(n, 3))
    return Ts


def from_vector(rotation_vector, translation):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotation_vector).as_matrix()
    T[:3, 3] = translation
    return T


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 1e-4, 0.3, 3.0, np.pi - 1e-6])
def test_angle_is_right_from_zero_to_half_a_turn(angle):
    """Oracle: the angle the rotation was made from; relative 1e-8 even where cos(angle) rounds to 1."""
    T = from_vector(angle * np.array([0.6, -0.48, 0.64]), [1.0, 2.0, 3.0])
    errors = pose_errors(T[None], from_vector(np.zeros(3), [1.0, 2.0, 3.0])[None])
    assert errors.rotation_rad[0] == pytest.approx(angle, rel=1e-8, abs=1e-15)


@pytest.mark.parametrize("seed", range(3))
def test_errors_are_those_of_a_known_perturbation(seed):
    """Oracle: the perturbation applied on the right of the truth, by construction in the source frame."""
    Ts_true = random_poses(seed, 5)
    offset, turn = np.array([0.03, -0.04, 0.12]), np.array([0.0, 0.002, -0.001])
    errors = pose_errors(Ts_true @ from_vector(turn, offset), Ts_true)
    np.testing.assert_allclose(errors.components_m, np.tile(offset, (5, 1)), atol=1e-13)
    np.testing.assert_allclose(errors.translation_m, 0.13, atol=1e-13)
    np.testing.assert_allclose(errors.rotation_rad, np.linalg.norm(turn), rtol=1e-9)


def test_errors_do_not_depend_on_the_target_frame():
    """Oracle: symmetry; the same rigid motion of the target frame of both poses changes nothing."""
    Ts_estimated, Ts_true, T_other_target = random_poses(0, 6), random_poses(1, 6), random_poses(2, 1)
    here, there = pose_errors(Ts_estimated, Ts_true), pose_errors(T_other_target @ Ts_estimated, T_other_target @ Ts_true)
    for value, other in zip(here, there, strict=True):
        np.testing.assert_allclose(value, other, atol=1e-12)


def test_bad_input_is_one_clear_sentence():
    """Oracle: the messages' contract, expected and got."""
    good, bad = random_poses(0, 4), random_poses(0, 4)
    bad[2, 0, 3] = np.nan
    with pytest.raises(DeloError, match=r"NaN or infinity in 1 of 4, first at 2"):
        pose_errors(bad, good)
    with pytest.raises(DeloError, match=r"rotations of determinant 1, got no rotation in 1 of 4, first at 2"):
        pose_errors(np.where(np.arange(4)[:, None, None] == 2, 0.0, good), good)
    with pytest.raises(DeloError, match=r"expected as many poses as Ts_true \(4\), got 3"):
        pose_errors(good[:3], good)
    with pytest.raises(DeloError, match=r"expected shape \(n, 4, 4\), got \(4, 3, 4\)"):
        checked_pair(good[:, :3], good)
