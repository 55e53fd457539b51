"""Scan to map, with the released weights, on streets known exactly."""

import functools

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import delo_jax
from delo_jax import inference
from delo_jax.errors import ConfigError
from delo_jax.pipeline.lidar_odometry import LidarOdometry
from delo_jax.pipeline.local_map import LocalMap
from delo_jax.pipeline.scan_to_map import MapTracker, register, surfaces_of
from tests.fixtures import errors, narrow_model
from tests.oracles import street
from tests.oracles.registration import hat


def pose_at(k):
    """A sensor that drives 1.2 m and turns a degree a frame."""
    return street.pose(1.2 * k - 8.0, 0.05 * k, 1.7 + 0.01 * k, yaw_deg=1.0 * k, roll_deg=0.1 * k)


@functools.cache
def weights():
    return delo_jax.load("delo-base")


@functools.cache
def prepared(k):
    return inference.prepare(weights(), sweep(k))


def sweep(k):
    return street.scan(pose_at(k), noise_m=0.01, seed=k).points


def street_map(num):
    """A map of the first frames, inserted where they truly were."""
    local_map = LocalMap()
    for k in range(num):
        local_map.insert(surfaces_of(prepared(k)), pose_at(k))
    return local_map


@pytest.mark.parametrize(("size", "num_learned"), [(0.1, 2), (1.0, 6)])
def test_scan_is_registered_to_the_map(size, num_learned):
    """Oracle: the pose that the scan was taken from; 1 cm of range noise, a start off by up to 1 m and 3 deg."""
    local_map, rng = street_map(4), np.random.default_rng(1)
    for _ in range(3):
        xi = size * rng.choice([-1, 1], 6) * np.repeat([np.radians(3.0) / np.sqrt(3), 1.0 / np.sqrt(3)], 3)
        start = pose_at(5) @ expm(hat(xi))
        fix = register(weights(), prepared(5), local_map, start, num_learned=num_learned)
        translation_m, rotation_deg = errors(start @ fix.T_start_lidar, pose_at(5))
        assert translation_m < 0.04
        assert rotation_deg < 0.15
        assert fix.score > 0.4
        assert fix.rms_m < 0.05


def test_wrong_place_scores_low():
    """Oracle: the same scan at its true place; 6 m aside nothing fits."""
    local_map = street_map(4)
    right = register(weights(), prepared(5), local_map, pose_at(5), num_learned=0)
    aside = pose_at(5) @ street.pose(0.0, 6.0, 0.0, yaw_deg=40.0)
    wrong = register(weights(), prepared(5), local_map, aside, num_learned=0)
    assert wrong.score < 0.6 * right.score


def test_no_map_no_pose():
    """Oracle: by hand: the guess stands, and the status says so."""
    tracker, guess = MapTracker(weights()), street.pose(1.0)
    estimate = tracker.locate(prepared(0), np.eye(4), guess)
    assert estimate.status == "rejected"
    np.testing.assert_array_equal(estimate.T_target_source, guess)


def test_map_needs_normals():
    """Oracle: the sentence: the paper's presets have raw points."""
    with pytest.raises(ConfigError, match="expected a network with a fine stage"):
        LidarOdometry(narrow_model("paper"), use_map=True)


def drive(scans, **options):
    """Frames of an odometry on the map."""
    odometry = LidarOdometry(weights(), use_map=True, **options)
    return [odometry.register(points) for points in scans]


def test_drive_on_the_map():
    """Oracle: the poses that the scans were taken from, at the end of 12 m; rotations stay rotations to float64."""
    frames = drive([sweep(k) for k in range(10)])
    truth = [np.linalg.inv(pose_at(0)) @ pose_at(k) for k in range(10)]
    for frame, T in zip(frames, truth, strict=True):
        translation_m, rotation_deg = errors(frame.T_world_lidar, T)
        assert translation_m < 0.08
        assert rotation_deg < 0.25
        R = frame.T_world_lidar[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert {frame.status for frame in frames} == {"ok"}
    sigmas = np.sqrt(np.diag(frames[-1].motion.covariance))
    assert np.all(sigmas[3:] > 1e-3)
    assert np.all(sigmas[3:] < 0.2)


def test_bad_scans_on_the_map_are_bridged():
    """Oracle: the truth; a scan of noise and one of a few points are rejected, and the drive goes on where it is."""
    rng = np.random.default_rng(0)
    scans = [sweep(k) for k in range(9)]
    scans[4] = rng.uniform([-40, -40, -2], [40, 40, 10], (20_000, 3)).astype(np.float32)
    scans[5] = sweep(5)[:30]
    frames = drive(scans)
    statuses = [frame.status for frame in frames]
    assert statuses[4:6] == ["rejected", "rejected"]
    assert statuses[:4] + statuses[6:] == ["ok"] * 7
    T = np.linalg.inv(pose_at(0)) @ pose_at(8)
    assert errors(frames[-1].T_world_lidar, T)[0] < 0.1
    assert frames[6].since == 3


def test_restart_elsewhere_is_found_by_the_network():
    """Oracle: the truth; the sensor wakes up 3 m on and 25 degrees turned, where no prediction leads."""
    jump = street.pose(0.0, 0.0, 0.0, yaw_deg=25.0)
    poses = [pose_at(k) for k in (0, 1, 2, 3)] + [pose_at(5.5) @ jump, pose_at(6) @ jump]
    frames = drive([street.scan(T, noise_m=0.01, seed=k).points for k, T in enumerate(poses)])
    for frame, T in zip(frames[4:], poses[4:], strict=True):
        translation_m, rotation_deg = errors(frame.T_world_lidar, np.linalg.inv(poses[0]) @ T)
        assert translation_m < 0.15
        assert rotation_deg < 0.5


def test_information_becomes_a_covariance():
    """Oracle: numpy's inverse of a well-conditioned matrix, in float64."""
    from delo_jax.uncertainty.covariance import from_information

    A = np.diag([3.0, 2.0, 4.0, 0.4, 0.5, 0.3])
    R = np.kron(np.eye(2), Rotation.from_euler("xyz", [0.3, -0.2, 0.7]).as_matrix())
    information = R @ A @ R.T
    found = from_information(information, sigma_m=0.05, num_planes=40.0)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(information) * 0.05**2 / 40.0, rtol=1e-9)
    np.testing.assert_allclose(found.aleatoric, np.diag(found.covariance))
    assert not found.epistemic.any()
    assert np.isfinite(from_information(np.zeros((6, 6)), sigma_m=0.05, num_planes=0.0).covariance).all()
