"""Streaming odometry, with a network that is never wrong."""

import dataclasses
import gc
import weakref

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from delo_jax.errors import ScanError
from delo_jax.pipeline.lidar_odometry import LidarOdometry
from tests.fixtures import errors, tiny_model
from tests.oracles import street
from tests.oracles.registration import hat
from tests.pipeline.exact_fakes import (
    FEW,
    LANDMARKS,
    PARAMS,
    SIGMA2,
    TWIST,
    ExactNetwork,
    ExactScan,
    kabsch,
    make,
    noise,
    screw,
    see,
    winding_road,
)

EPOCH_NS = 1_317_384_506_123_456_789


def test_poses_chain_into_the_trajectory():
    """Oracle: the trajectory the scans were seen from. `frame.motion` maps current points into the previous scan."""
    odometry, _ = make()
    truth = winding_road(8)
    frames = [odometry.register(see(T)) for T in truth]
    for k, frame in enumerate(frames):
        np.testing.assert_allclose(frame.T_world_lidar, truth[k], atol=1e-4)  # float32 points at 40 m, 7 motions
        previous = truth[max(k - 1, 0)]
        np.testing.assert_allclose(frame.motion.T_target_source, np.linalg.inv(previous) @ truth[k], atol=2e-5)
        assert (frame.status, frame.motion.status) == ("ok", "ok")
        assert frame.stamp_ns == k * 100_000_000
        assert frame.T_world_lidar.dtype == np.float64
    assert frames[1].T_world_lidar[0, 3] == pytest.approx(1.0, abs=0.05)  # forward is +x
    np.testing.assert_array_equal(odometry.trajectory().Ts_world_lidar, [frame.T_world_lidar for frame in frames])


def test_source_is_the_earlier_scan():
    """Oracle: the order of the calls."""
    odometry, network = make()
    scans = [see(T) for T in winding_road(3)]
    for points in scans:
        odometry.register(points)
    assert all(source is scans[k] and target is scans[k + 1] for k, (source, target) in enumerate(network.pairs))


def test_guess_is_constant_velocity_whatever_the_stamps():
    """Oracle: scipy's expm; from the third scan on the guess of a drive at constant velocity is already the answer."""
    odometry, network = make()
    stamps_s = [0.0, 0.1, 0.25, 0.3, 0.7]
    for time in stamps_s:
        odometry.register(see(screw(time)), stamp_ns=EPOCH_NS + round(time * 1e9))
    np.testing.assert_array_equal(network.starts[0], np.eye(4))
    for k in range(1, 4):
        np.testing.assert_allclose(network.starts[k], screw(stamps_s[k] - stamps_s[k + 1]), atol=2e-4)  # 0.1 s of float32 over 0.4 s


def test_missing_stamps_go_on_from_the_last_one():
    """Oracle: by hand, 0.1 s a frame; also after stamps that were given."""
    odometry, _ = make()
    stamps = [odometry.register(see(np.eye(4)), stamp_ns=stamp).stamp_ns for stamp in (None, None, 7_000_000_000, None)]
    stamps.append(odometry.reject("unreadable").stamp_ns)
    assert stamps == [0, 100_000_000, 7_000_000_000, 7_100_000_000, 7_200_000_000]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros((60, 4)),), r"points: expected an array of shape \(n, 3\)"),
        ((np.zeros((60, 3), bool),), "points: expected numbers, got dtype bool"),
        ((see(np.eye(4)), 100_000_000), "stamp_ns: expected more than the last stamp 100000000, got 100000000; sort the scans"),
        ((see(np.eye(4)), 5), "stamp_ns: expected more than"),
        ((see(np.eye(4)), None, np.zeros(59)), r"times_s: expected one time per point, shape \(60,\), got \(59,\)"),
        ((see(np.eye(4)), None, np.full(60, "a")), "times_s: expected numbers, got dtype <U1"),
        ((see(np.eye(4)), None, np.full(60, 1.3e9)), "times_s: expected seconds relative to the stamp, within 1 s, got 1.3e[+]09 s"),
    ],
)
def test_refused_scan_leaves_no_trace(arguments, message):
    """Oracle: the same drive without the refused scan, byte by byte."""
    truth = winding_road(5)
    (disturbed, _), (quiet, _) = make(), make()
    for k, T in enumerate(truth):
        if k == 2:
            with pytest.raises(ScanError, match=message):
                disturbed.register(*arguments)
        found, expected = disturbed.register(see(T)), quiet.register(see(T))
        assert found.T_world_lidar.tobytes() == expected.T_world_lidar.tobytes()
        assert found.covariance.tobytes() == expected.covariance.tobytes()
        assert found.stamp_ns == expected.stamp_ns
    assert len(disturbed.trajectory()) == len(truth)


def skewed(seconds, times):
    """A sweep of the drive at constant velocity: landmark i at its own time, in the sensor's frame of that instant."""
    Ts_lidar_world = expm(np.array([hat(-(seconds + t) * TWIST) for t in times]))
    return np.einsum("nij,nj->ni", Ts_lidar_world[:, :3], np.hstack([LANDMARKS, np.ones((len(LANDMARKS), 1))])).astype(np.float32)


def test_moving_sweeps_are_compensated_from_the_first_pair_on():
    """Oracle: closed form. Every scan that is aligned, but for the first try of the first pair, shows the world at its stamp.

    Tolerance: what float32 and the error of the first try leave of 9 m/s and 0.3 rad/s at 45 m over half a sweep.
    """
    step = (9.0 + 0.3 * 45.0) * 0.1 / 127 / 2
    odometry, network = make()
    times = np.random.default_rng(0).uniform(-0.05, 0.05, len(LANDMARKS))
    frames = [odometry.register(skewed(0.1 * k, times), times_s=times) for k in range(4)]
    assert len(network.pairs) == 4  # the first pair is solved twice
    for (source, target), k in zip(network.pairs[1:], (0, 1, 2), strict=True):
        assert np.abs(source - see(screw(0.1 * k))).max() < step
        assert np.abs(target - see(screw(0.1 * k + 0.1))).max() < step
    raw = network.pairs[0][1]
    assert np.abs(raw - see(screw(0.1))).max() > 10 * step
    for k, frame in enumerate(frames):
        np.testing.assert_allclose(frame.T_world_lidar, screw(0.1 * k), atol=2 * step)


def test_first_pair_starts_again_from_its_own_answer():
    """Oracle: the call; the second try starts where the first one ended."""
    odometry, network = make()
    times = np.linspace(-0.05, 0.05, len(LANDMARKS))
    for k in range(2):
        odometry.register(skewed(0.1 * k, times), times_s=times)
    np.testing.assert_array_equal(network.starts[0], np.eye(4))
    np.testing.assert_allclose(network.starts[1], screw(-0.1), atol=1e-4)


def test_first_pair_that_fails_the_second_time():
    """Oracle: the scans as measured, and scipy's solution for them; the second try leaves nothing behind."""
    network = ExactNetwork()

    def align(params, source, target, start):
        estimate = network.align(params, source, target, start)
        return dataclasses.replace(estimate, status="rejected", reason="bad luck") if len(network.pairs) == 2 else estimate

    odometry = LidarOdometry(PARAMS, use_map=False, prepare=network.prepare, align=align)
    times = np.linspace(-0.05, 0.05, len(LANDMARKS))
    scans = [skewed(0.1 * k, times) for k in range(3)]
    frames = [odometry.register(points, times_s=times) for points in scans]
    assert [frame.status for frame in frames] == ["ok"] * 3
    np.testing.assert_allclose(frames[1].motion.T_target_source, kabsch(scans[1], scans[0]), atol=1e-9)
    source, target = network.pairs[2]
    np.testing.assert_array_equal(source, scans[1])
    assert np.abs(target - see(screw(0.2))).max() < np.abs(scans[2] - see(screw(0.2))).max() / 4


@pytest.mark.parametrize("timed", [False, True])
def test_caller_may_reuse_its_buffers(timed):
    """Oracle: the same drive with a new array for every scan, byte by byte."""
    given, kept = make(ExactNetwork(copy=True))[0], make(ExactNetwork(copy=True))[0]
    times = np.random.default_rng(0).uniform(-0.05, 0.05, len(LANDMARKS))
    buffer, times_buffer = np.empty((len(LANDMARKS), 3), np.float32), np.empty(len(LANDMARKS))
    for k in range(4):
        points = skewed(0.1 * k, times) if timed else see(screw(0.1 * k))
        buffer[:], times_buffer[:] = points, times
        frame = given.register(buffer, times_s=times_buffer if timed else None)
        buffer[:], times_buffer[:] = np.nan, np.nan
        expected = kept.register(points, times_s=times.copy() if timed else None)
        assert frame.T_world_lidar.tobytes() == expected.T_world_lidar.tobytes()
        assert frame.status == "ok"


def test_frames_belong_to_the_caller():
    """Oracle: the same drive whose frames nobody touches, byte by byte, through an outage; the trajectory too."""
    (spoilt, _), (quiet, _) = make(ExactNetwork(reach_m=15.0)), make(ExactNetwork(reach_m=15.0))
    scans = [see(T) for T in winding_road(4)] + [FEW, noise(0)] + [see(street.pose(90.0) @ T) for T in winding_road(3)]
    for points in scans:
        frame, expected = spoilt.register(points), quiet.register(points)
        assert frame.T_world_lidar.tobytes() == expected.T_world_lidar.tobytes()
        assert frame.covariance.tobytes() == expected.covariance.tobytes()
        assert frame.motion.covariance.tobytes() == expected.motion.covariance.tobytes()
        motion = frame.motion
        for array in (frame.T_world_lidar, frame.covariance, motion.T_target_source, motion.covariance, motion.aleatoric, motion.epistemic):
            array[:] = np.nan
    np.testing.assert_array_equal(spoilt.trajectory().Ts_world_lidar, quiet.trajectory().Ts_world_lidar)
    np.testing.assert_array_equal(spoilt.trajectory().covariances, quiet.trajectory().covariances)


def test_deskew_can_be_switched_off():
    """Oracle: the points that were given."""
    odometry, network = make(deskew=False)
    times = np.linspace(-0.05, 0.05, len(LANDMARKS))
    scans = [skewed(0.1 * k, times) for k in range(3)]
    for points in scans:
        odometry.register(points, times_s=times)
    assert all(prepared is points for prepared, points in zip(network.prepared, scans, strict=True))


def test_world_covariance_is_that_of_noisy_drives():
    """Oracle: Monte Carlo. 2,000 drives whose estimates scatter as they say; three standard errors of a correlation are 7 %."""
    truth = winding_road(5)
    odometry, _ = make()
    frame = [odometry.register(see(T)) for T in truth][-1]
    rng = np.random.default_rng(0)
    num = 2000
    T_world = np.tile(np.eye(4), (num, 1, 1))
    for k in range(4):
        T_target_source = np.linalg.inv(truth[k + 1]) @ truth[k]
        noise = rng.normal(size=(num, 6)) * np.sqrt(SIGMA2)
        scatter = np.tile(np.eye(4), (num, 1, 1))  # exp(xi) of twists this small, but for the product of angle and length
        scatter[:, :3, :3], scatter[:, :3, 3] = Rotation.from_rotvec(noise[:, :3]).as_matrix(), noise[:, 3:]
        estimates = T_target_source @ scatter
        T_world = T_world @ np.linalg.inv(estimates)
    apart = np.linalg.inv(truth[-1]) @ T_world
    samples = np.hstack([Rotation.from_matrix(apart[:, :3, :3]).as_rotvec(), apart[:, :3, 3]])
    scale = np.sqrt(np.outer(np.diag(frame.covariance), np.diag(frame.covariance)))
    np.testing.assert_allclose(np.cov(samples.T) / scale, frame.covariance / scale, atol=0.1)


def test_scans_do_not_pile_up():
    """Oracle: weak references; of all scans given only the last stays alive in the odometry."""

    def prepare(params, points, times_s):
        return ExactScan(points, points)

    odometry = LidarOdometry(PARAMS, use_map=False, prepare=prepare, align=lambda *arguments: ExactNetwork().align(*arguments))
    alive = []
    for T in winding_road(6):
        points = see(T)
        alive.append(weakref.ref(points))
        odometry.register(points)
        del points
    gc.collect()
    assert sum(reference() is not None for reference in alive) <= 1


def test_frames_are_timed():
    """Oracle: the documented stages; seconds, not negative."""
    odometry, _ = make()
    frame = odometry.register(see(np.eye(4)))
    assert frame.timing.keys() == {"prepare", "solve"}
    assert all(0.0 <= seconds < 60.0 for seconds in frame.timing.values())


def test_network_takes_the_place_of_the_fake():
    """Oracle: the poses of the analytic street; untrained weights keep 0.9 m steps within 30 cm. Twice the same bytes."""
    truth = [street.pose(0.9 * k, 0.0, yaw_deg=1.5 * k) for k in range(4)]
    scans = [street.scan(T, noise_m=0.01, seed=k).points for k, T in enumerate(truth)]
    runs = [LidarOdometry(tiny_model(), use_map=False) for _ in range(2)]
    frames = [[odometry.register(points) for points in scans] for odometry in runs]
    for k, frame in enumerate(frames[0][1:], start=1):
        step = np.linalg.inv(truth[k - 1]) @ truth[k]
        assert errors(frame.motion.T_target_source, step)[0] < 0.3
        assert frame.status != "rejected"
        assert np.linalg.eigvalsh(frame.covariance).min() > 0
    assert all(a.T_world_lidar.tobytes() == b.T_world_lidar.tobytes() for a, b in zip(*frames, strict=True))
    lost = runs[0].register(np.zeros((0, 3)))
    assert lost.status == "rejected"
    assert lost.motion.reason.startswith("target has 0 usable points")
    np.testing.assert_allclose(lost.motion.T_target_source, frames[0][-1].motion.T_target_source, atol=1e-6)  # as fast as before
