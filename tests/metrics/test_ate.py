import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PosePath3D
from scipy.spatial.transform import Rotation

from delo_jax.errors import DeloError
from delo_jax.metrics.ate import absolute_errors, align, relative_errors


def noisy_track(seed, *, noise_m=0.2, num_frames=60):
    """A curved track and an estimate of it in another world frame, with noise on every pose."""
    rng = np.random.default_rng(seed)
    Ts_true = np.tile(np.eye(4), (num_frames, 1, 1))
    yaw = 0.05 * np.arange(num_frames)
    Ts_true[:, :3, :3] = Rotation.from_euler("z", yaw[:, None]).as_matrix()
    Ts_true[:, :3, 3] = np.stack([20 * np.sin(yaw), 20 * (1 - np.cos(yaw)), 0.1 * yaw], axis=-1)
    T_other_true = np.eye(4)
    T_other_true[:3, :3] = Rotation.random(rng=rng).as_matrix()
    T_other_true[:3, 3] = 50 * rng.normal(size=3)
    Ts_noise = np.tile(np.eye(4), (num_frames, 1, 1))
    Ts_noise[:, :3, :3] = Rotation.from_rotvec(0.02 * rng.normal(size=(num_frames, 3))).as_matrix()
    Ts_noise[:, :3, 3] = noise_m * rng.normal(size=(num_frames, 3))
    return T_other_true @ Ts_true @ Ts_noise, Ts_true, T_other_true


@pytest.mark.parametrize("seed", range(3))
def test_absolute_errors_are_those_of_evo(seed):
    """Oracle: evo's APE of the translation after its own Umeyama alignment."""
    Ts_estimated, Ts_true, _ = noisy_track(seed)
    reference, path = PosePath3D(poses_se3=list(Ts_true)), PosePath3D(poses_se3=list(Ts_estimated))
    path.align(reference)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, path))
    errors = absolute_errors(Ts_estimated, Ts_true)
    np.testing.assert_allclose(errors.translation_m, ape.error, atol=1e-9)
    assert errors.rmse_m == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), abs=1e-9)


@pytest.mark.parametrize("gap", [1, 5])
def test_relative_errors_are_those_of_evo(gap):
    """Oracle: evo's RPE over all pairs of frames `gap` apart."""
    Ts_estimated, Ts_true, _ = noisy_track(0)
    data = PosePath3D(poses_se3=list(Ts_true)), PosePath3D(poses_se3=list(Ts_estimated))
    errors = relative_errors(Ts_estimated, Ts_true, gap=gap)
    for values, relation in (
        (errors.translation_m, metrics.PoseRelation.translation_part),
        (errors.rotation_rad, metrics.PoseRelation.rotation_angle_rad),
    ):
        rpe = metrics.RPE(relation, delta=gap, delta_unit=metrics.Unit.frames, all_pairs=True)
        rpe.process_data(data)
        np.testing.assert_allclose(values, rpe.error, atol=1e-9)


def test_alignment_is_recovered_exactly():
    """Oracle: the transform that made the estimate, without noise."""
    Ts_estimated, Ts_true, T_other_true = noisy_track(0, noise_m=0.0)
    errors = absolute_errors(Ts_estimated, Ts_true)
    np.testing.assert_allclose(errors.T_true_estimated, np.linalg.inv(T_other_true), atol=1e-9)
    assert errors.rmse_m < 1e-9


@pytest.mark.parametrize("direction", [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.3, -2.0, 0.1)], ids=["standing", "along x", "straight"])
def test_degenerate_tracks_align_by_a_rotation(direction):
    """Oracle: by hand; a shifted straight or standing track fits without error, and the answer is a rotation."""
    true = np.outer(np.arange(5.0), direction)
    T_true_estimated = align(true + [3.0, 2.0, 1.0], true)
    R = T_true_estimated[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    np.testing.assert_allclose((true + [3.0, 2.0, 1.0]) @ R.T + T_true_estimated[:3, 3], true, atol=1e-12)


def test_mirrored_track_is_not_aligned_by_a_reflection():
    """Oracle: scipy's Rotation.align_vectors on the centred positions."""
    rng = np.random.default_rng(0)
    true = rng.normal(size=(30, 3))
    mirrored = true * [1.0, 1.0, -1.0]
    expected, _ = Rotation.align_vectors(true - true.mean(axis=0), mirrored - mirrored.mean(axis=0))
    np.testing.assert_allclose(align(mirrored, true)[:3, :3], expected.as_matrix(), atol=1e-9)


def test_bad_input_is_one_clear_sentence():
    """Oracle: the messages' contract, expected and got."""
    Ts, _, _ = noisy_track(0, num_frames=4)
    with pytest.raises(DeloError, match="gap: expected 1 to 3 for 4 poses, got 4"):
        relative_errors(Ts, Ts, gap=4)
    with pytest.raises(DeloError, match="expected one or more poses, got none"):
        absolute_errors(Ts[:0], Ts[:0])
