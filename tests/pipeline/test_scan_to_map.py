"""Scan to map, with the released weights, on streets known exactly."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import delo_jax
from delo_jax import inference
from delo_jax.errors import ConfigError
from delo_jax.inference import Estimate
from delo_jax.pipeline.lidar_odometry import LidarOdometry
from delo_jax.pipeline.local_map import LocalMap, Surroundings, surfaces_of
from delo_jax.pipeline.scan_to_map import REACH_M, MapTracker, Steps, register
from tests.fixtures import errors, narrow_model, thinned
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
        local_map.insert(surfaces_of(prepared(k).scan), pose_at(k))
    return local_map


def fixed(local_map, start, num_learned):
    """The sixth scan registered from a start."""
    near = Surroundings(local_map, start, REACH_M)
    return register(weights(), prepared(5), near, np.eye(4), num_learned=num_learned, num_rounds=2)


@pytest.mark.parametrize(("size", "num_learned"), [(0.1, 2), (1.0, 6)])
def test_scan_is_registered_to_the_map(size, num_learned):
    """Oracle: the pose that the scan was taken from; 1 cm of range noise, a start off by up to 1 m and 3 deg."""
    local_map, rng = street_map(4), np.random.default_rng(1)
    for _ in range(3):
        xi = size * rng.choice([-1, 1], 6) * np.repeat([np.radians(3.0) / np.sqrt(3), 1.0 / np.sqrt(3)], 3)
        start = pose_at(5) @ expm(hat(xi))
        fix = fixed(local_map, start, num_learned)
        translation_m, rotation_deg = errors(start @ fix.T_start_lidar, pose_at(5))
        assert translation_m < 0.04
        assert rotation_deg < 0.15
        assert fix.score > 0.4
        assert fix.rms_m < 0.05


def test_wrong_place_scores_low():
    """Oracle: the same scan at its true place; 6 m aside nothing fits."""
    local_map = street_map(4)
    right = fixed(local_map, pose_at(5), 0)
    aside = pose_at(5) @ street.pose(0.0, 6.0, 0.0, yaw_deg=40.0)
    wrong = fixed(local_map, aside, 0)
    assert wrong.score < 0.6 * right.score


def test_no_map_no_pose():
    """Oracle: by hand: the guess stands, and the status says so."""
    tracker, guess = MapTracker(weights(), Steps()), street.pose(1.0)
    estimate = tracker.locate(prepared(0), np.eye(4), [guess], 0.1, recovering=False).motion
    assert estimate.status == "rejected"
    np.testing.assert_array_equal(estimate.T_target_source, guess)


def test_map_needs_normals():
    """Oracle: the sentence: the paper's presets have raw points."""
    with pytest.raises(ConfigError, match="expected a network with a fine stage"):
        LidarOdometry(narrow_model("paper"))


def drive(scans, params=None, **options):
    """Frames of an odometry on the map."""
    odometry = LidarOdometry(weights() if params is None else params, **options)
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
    assert np.all(sigmas[3:] > 2e-4)
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


def body_pose(time_s):
    """A sensor that drives 12 m/s and nods and sways at 1.5 Hz, as no constant velocity says."""
    nod, sway = 0.8 * np.sin(2 * np.pi * 1.5 * time_s), 0.6 * np.cos(2 * np.pi * 1.5 * time_s)
    return street.pose(12.0 * time_s - 8.0, 0.05, 1.7, yaw_deg=2.0 * sway, pitch_deg=nod, roll_deg=sway)


def rolling_sweep(k, num_groups=24):
    """A scan as measured by the moving sensor: groups of azimuths, each from where the sensor was; and the times of its points."""
    edges = np.linspace(-np.pi, np.pi, num_groups + 1)
    points, times = [], []
    for index in range(num_groups):
        time_s = -0.05 * (edges[index] + edges[index + 1]) / (2 * np.pi)
        seen = street.scan(body_pose(0.1 * k + time_s), noise_m=0.01, seed=1000 * k + index).points
        azimuth = np.arctan2(seen[:, 1], seen[:, 0])
        here = seen[(azimuth >= edges[index]) & (azimuth < edges[index + 1])]
        points.append(here)
        times.append(np.full(len(here), time_s))
    return np.concatenate(points), np.concatenate(times)


def test_velocity_within_a_sweep_is_found():
    """Oracle: the poses at the stamps; a body that nods is followed twice as well when the sweep's own velocity is solved for."""
    sweeps, truth = [rolling_sweep(k) for k in range(7)], [body_pose(0.1 * k) for k in range(7)]
    rotation_deg = {}
    for again in (False, True):
        odometry = LidarOdometry(weights(), steps=Steps(deskew_again=again))
        frames = [odometry.register(points, times_s=times) for points, times in sweeps]
        assert {frame.status for frame in frames} == {"ok"}
        found = [errors(frame.motion.T_target_source, np.linalg.inv(truth[k]) @ truth[k + 1]) for k, frame in enumerate(frames[1:])]
        rotation_deg[again] = np.mean([deg for _, deg in found[2:]])
    assert rotation_deg[True] < 0.5 * rotation_deg[False]


def test_a_scan_that_comes_twice_does_not_mislead_the_next():
    """Oracle: the truth; the second copy says that the sensor stands still, and the next scan is 2.4 m on."""
    frames = drive([sweep(k) for k in (0, 1, 2, 3, 3, 5, 6)])
    assert frames[4].status == "ok"
    for frame, k in zip(frames[5:], (5, 6), strict=True):
        assert errors(frame.T_world_lidar, np.linalg.inv(pose_at(0)) @ pose_at(k))[0] < 0.1


def test_map_begins_anew_elsewhere():
    """Oracle: the motion between the two last scans; the sensor wakes up in another street, where the map fits nothing."""
    boxes = np.array([[x, y, 1.0, 1.5, 3.0, 7.0 * x] for x in range(-30, 50, 7) for y in (-7.0, 8.0, 15.0)])
    there = [street.scan(pose_at(k), boxes=boxes, noise_m=0.01, seed=k).points for k in (20, 21, 22, 23)]
    frames = drive([sweep(k) for k in (0, 1, 2)] + there)
    assert [frame.status for frame in frames[-2:]] == ["ok", "ok"]
    for k in (22, 23):
        found = np.linalg.inv(frames[k - 18].T_world_lidar) @ frames[k - 17].T_world_lidar
        assert errors(found, np.linalg.inv(pose_at(k - 1)) @ pose_at(k))[0] < 0.1


def in_a_crowd(k, num_blobs):
    """A scan with things in it that are nowhere else."""
    rng = np.random.default_rng(k)
    blobs = rng.uniform([-40, -40, 0], [40, 40, 12], (num_blobs, 1, 3)) + 0.3 * rng.normal(size=(num_blobs, 40, 3))
    return np.concatenate([sweep(k), blobs.reshape(-1, 3).astype(np.float32)])


def test_score_that_falls_is_noticed():
    """Oracle: the construction: many surfaces of a scan are nowhere else; its pose is still right, and the next scan is ok."""
    frames = drive([*(sweep(k) for k in range(6)), in_a_crowd(6, 300), sweep(7)])
    assert [frame.status for frame in frames] == ["ok"] * 6 + ["low_confidence", "ok"]
    assert frames[6].motion.confidence < 0.8
    assert errors(frames[6].T_world_lidar, np.linalg.inv(pose_at(0)) @ pose_at(6))[0] < 0.1


def test_network_stands_where_the_map_does_not_fit():
    """Oracle: the truth; scans in so thick a crowd that the map refuses them, one after the other, still follow from each other."""
    frames = drive([*(sweep(k) for k in range(4)), in_a_crowd(4, 600), sweep(5), sweep(6)])
    assert [frame.status for frame in frames] == ["ok"] * 4 + ["low_confidence", "ok", "ok"]
    assert frames[4].motion.reason.startswith("the map does not fit (confidence 0.")
    for k in (4, 5, 6):
        assert errors(frames[k].T_world_lidar, np.linalg.inv(pose_at(0)) @ pose_at(k))[0] < 0.15


def test_two_bad_scans_do_not_cost_the_map():
    """Oracle: the truth; scans of noise, one after the other, take over nothing: the next good scan is where it is."""
    rng = np.random.default_rng(0)
    noise = [rng.uniform([-40, -40, -2], [40, 40, 10], (20_000, 3)).astype(np.float32) for _ in range(2)]
    frames = drive([*(sweep(k) for k in range(4)), *noise, sweep(6), sweep(7)])
    assert [frame.status for frame in frames[4:6]] == ["rejected", "rejected"]
    for frame, k in zip(frames[6:], (6, 7), strict=True):
        assert (frame.status, frame.since) == ("ok", 3 if k == 6 else 6)
        assert errors(frame.T_world_lidar, np.linalg.inv(pose_at(0)) @ pose_at(k))[0] < 0.1


def test_unreadable_scan_on_the_map():
    """Oracle: the truth; the scan after one that could not be read is measured across the gap."""
    odometry = LidarOdometry(weights())
    for k in range(4):
        odometry.register(sweep(k))
    assert odometry.reject("file is truncated").status == "rejected"
    frame = odometry.register(sweep(5))
    assert (frame.status, frame.since) == ("ok", 3)
    assert errors(frame.T_world_lidar, np.linalg.inv(pose_at(0)) @ pose_at(5))[0] < 0.1


def test_few_points_are_enough():
    """Oracle: the truth; a scan of fewer points than the learned steps take, at a start 2 m and 10 deg off, which asks two subsets."""
    scan = dataclasses.replace(prepared(5), scan=thinned(prepared(5).scan, 400, 100))
    assert scan.num_points == 400
    tracker = MapTracker(weights(), Steps())
    tracker.restart(prepared(4), pose_at(4))
    guess = np.linalg.inv(pose_at(4)) @ pose_at(5) @ street.pose(1.4, 1.4, 0.0, yaw_deg=10.0)
    found = tracker.locate(scan, pose_at(4), [guess], 0.1, recovering=True).motion
    assert errors(pose_at(4) @ found.T_target_source, pose_at(5))[0] < 0.1


@pytest.mark.parametrize("name", ["fine_step", "robust_steps"])
def test_no_number_no_pose(monkeypatch, name):
    """Oracle: the status; a solve that breaks down in the middle of a drive is a rejected frame, not an exception."""
    odometry = LidarOdometry(weights())
    for k in range(3):
        odometry.register(sweep(k))
    function = getattr(inference, name)

    def broken(*arguments, **options):
        return jax.tree.map(lambda leaf: np.full_like(leaf, np.nan), jax.device_get(function(*arguments, **options)))

    with monkeypatch.context() as patch:
        patch.setattr(inference, name, broken)
        patch.setattr(
            odometry, "_align", lambda params, source, target, start: dataclasses.replace(Estimate.exact(start), status="rejected")
        )
        assert odometry.register(sweep(3)).status == "rejected"
    assert odometry.register(sweep(4)).status == "ok"


def test_same_drive_same_bytes():
    """Oracle: repetition."""
    first, second = (drive([sweep(k) for k in (0, 1, 2, 5, 6)]) for _ in range(2))
    assert all(a.T_world_lidar.tobytes() == b.T_world_lidar.tobytes() for a, b in zip(first, second, strict=True))
    assert all(a.covariance.tobytes() == b.covariance.tobytes() for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize("options", [{"num_learned": -1}, {"num_rounds": -1}])
def test_steps_are_counted_from_zero(options):
    """Oracle: the sentence."""
    with pytest.raises(ConfigError, match="steps.num_.*0 or more"):
        Steps(**options)
