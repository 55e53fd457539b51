"""Covariances of a drive on the map, with the released network on streets known exactly."""

import dataclasses

import numpy as np

from delo_jax.geometry import se3
from delo_jax.pipeline.lidar_odometry import LidarOdometry
from delo_jax.uncertainty.stream import StreamNoise
from tests.oracles import street
from tests.pipeline.test_scan_to_map import drive, in_a_crowd, pose_at, sweep, weights

NUMBERS = StreamNoise(0.3, 0.01, 0.02, 0.03, 0.003, 0.05, 0.01)


def adjoint(T):
    """Of a pose, by hand."""
    R, (x, y, z) = T[:3, :3], T[:3, 3]
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.block([[R, np.zeros((3, 3))], [skew @ R, R]])


def composed(before, frame):
    """The covariance in the world by adding that of the motion as if it were independent."""
    Ad = adjoint(np.linalg.inv(frame.motion.T_target_source))
    return Ad @ before @ Ad.T + frame.motion.covariance


def test_calibrated_covariances_on_the_map():
    """Oracle: by hand. Of a motion: a share of the registration's own at both ends, and the drift in between; in the world: two errors on
    the map, and all the drift. The registration's own is what the same drive says without numbers; poses are the same to the bit.
    """
    scans = [sweep(k) for k in range(6)]
    plain, frames = drive(scans, with_stream(None), stamp_sigma_s=0.0), drive(scans, with_stream(NUMBERS), stamp_sigma_s=0.0)
    drift = local = np.zeros((6, 6))
    for k, (frame, other) in enumerate(zip(frames, plain, strict=True)):
        assert frame.T_world_lidar.tobytes() == other.T_world_lidar.tobytes()
        if k == 0:
            assert not frame.covariance.any()
            continue
        classical, T = other.motion.covariance, frame.motion.T_target_source
        Ad = adjoint(np.linalg.inv(T))
        step = np.linalg.norm(T[:3, 3]) * (0.05**2 * classical + np.diag([0, 0, 0, 0.01**2, 0, 0]))
        before, local = Ad @ local @ Ad.T, 0.3**2 * classical
        drift = Ad @ drift @ Ad.T + step
        if k == 1:  # the first scan of the map is as wrong as the second
            before, drift = local, drift + local
        np.testing.assert_allclose(frame.motion.covariance, before + local + step, rtol=1e-5, atol=1e-12)
        np.testing.assert_allclose(frame.covariance, drift + local, rtol=1e-5, atol=1e-12)
        np.testing.assert_allclose(frame.motion.aleatoric, np.diag(before + local), rtol=1e-5)
        np.testing.assert_allclose(frame.motion.epistemic, np.diag(step), rtol=1e-5)
    assert frames[5].covariance[0, 0] < 0.7 * composed(frames[4].covariance, frames[5])[0, 0]  # roll: hardly any drift


def test_stamps_that_are_not_exact_are_in_the_covariance():
    """Oracle: by hand: sigma^2 v v^T at both ends of a motion, v the body velocity, at one end of a pose; the drift knows none of it."""
    scans, sigma = [sweep(k) for k in range(5)], 0.004
    exact, frames = (drive(scans, with_stream(NUMBERS), stamp_sigma_s=one) for one in (0.0, sigma))
    moved = [sigma**2 * np.outer(v, v) for v in (se3.log(frame.motion.T_target_source) / 0.1 for frame in frames[1:])]
    Ad = adjoint(np.linalg.inv(frames[4].motion.T_target_source))
    np.testing.assert_allclose(
        frames[4].motion.covariance - exact[4].motion.covariance, Ad @ moved[2] @ Ad.T + moved[3], rtol=1e-5, atol=1e-12
    )
    np.testing.assert_allclose(frames[4].local - exact[4].local, moved[3], rtol=1e-5, atol=1e-12)


def test_weights_without_numbers_of_a_drive_chain_as_before():
    """Oracle: the composition of the motions' covariances."""
    frames, before = drive([sweep(k) for k in range(5)], with_stream(None), stamp_sigma_s=0.0), np.zeros((6, 6))
    for frame in frames:
        before = composed(before, frame)
        np.testing.assert_allclose(frame.covariance, before, rtol=1e-9, atol=1e-15)
        np.testing.assert_array_equal(frame.motion.epistemic, 0.0)


def test_sweeps_that_change_their_velocity_are_known_less():
    """Oracle: by hand: the numbers of a swing alone, and a drive that turns less from scan to scan than the last time."""
    numbers = NUMBERS._replace(share=0.0, drift_share=0.0, drift_forward=0.0, heave_pitch=0.0)
    odometry, frames = LidarOdometry(with_stream(numbers), stamp_sigma_s=0.0), []
    for k in range(4):
        points = sweep(k)
        frames.append(odometry.register(points, times_s=np.zeros(len(points))))
    velocities = [np.array([0.0, 0, 0, 0, 0, 0])] + [se3.log(frame.motion.T_target_source) / 0.1 for frame in frames[1:]]
    first = (velocities[2] - velocities[1]) ** 2
    squares = 0.5 * first + 0.5 * (velocities[3] - velocities[2]) ** 2
    K2 = np.array([0.01, 0.01, 0.01, 0.02, 0.02, 0.03]) ** 2
    Ad = adjoint(np.linalg.inv(frames[3].motion.T_target_source))
    expected = Ad @ np.diag(K2 * first) @ Ad.T + np.diag(K2 * squares)
    np.testing.assert_allclose(frames[3].motion.covariance, expected, rtol=1e-5, atol=1e-15)
    assert not frames[1].covariance.any()  # nothing has changed yet


def test_rejected_frames_are_wide_and_the_map_takes_over_again():
    """Oracle: by hand. The covariance of a bad scan is that of an unmeasured motion; the next good one knows nothing of it."""
    scans = [sweep(k) for k in range(6)]
    scans[4] = scans[4][:30]
    frames = drive(scans, with_stream(NUMBERS), stamp_sigma_s=0.0)
    assert [frame.status for frame in frames] == ["ok"] * 4 + ["rejected", "ok"]
    unknown = np.repeat([np.radians(30.0) ** 2, 25.0], 3)
    np.testing.assert_allclose(np.diag(frames[4].motion.covariance), unknown, rtol=1e-9)
    np.testing.assert_allclose(frames[4].covariance, composed(frames[3].covariance, frames[4]), rtol=1e-9)
    assert np.all(np.diag(frames[5].covariance) < 0.05**2)
    assert np.all(np.diag(frames[5].motion.covariance) < 0.05**2)


def with_stream(numbers):
    """The released network with these numbers of a drive on the map, or without any."""
    rest = {name: value for name, value in weights().variables.items() if name != "stream"}
    return dataclasses.replace(weights(), variables=rest | ({} if numbers is None else {"stream": numbers.stored()}))


def test_what_is_lost_stays_in_the_world_and_leaves_the_motions():
    """Oracle: by hand: where the new street is was never measured, 5 m of standard deviation; motions on its map are known again."""
    boxes = np.array([[x, y, 1.0, 1.5, 3.0, 7.0 * x] for x in range(-30, 50, 7) for y in (-7.0, 8.0, 15.0)])
    there = [street.scan(pose_at(k), boxes=boxes, noise_m=0.01, seed=k).points for k in (20, 21, 22, 23)]
    last = drive([sweep(k) for k in (0, 1, 2)] + there, with_stream(NUMBERS), stamp_sigma_s=0.0)[-1]
    assert last.status == "ok"
    assert np.all(np.diag(last.covariance)[3:] > 4.9**2)
    assert np.all(np.diag(last.motion.covariance)[3:] < 0.05**2)


def test_network_motion_chains_and_the_old_map_forgets_it():
    """Oracle: by hand. The network's motion adds to the world covariance; the scan after it is on the old map, as if it had not been."""
    scans = [*(sweep(k) for k in range(4)), in_a_crowd(4, 600), sweep(5)]
    plain, frames = drive(scans, with_stream(None), stamp_sigma_s=0.0), drive(scans, with_stream(NUMBERS), stamp_sigma_s=0.0)
    assert frames[4].motion.reason.startswith("the map does not fit")
    np.testing.assert_allclose(frames[4].covariance, composed(frames[3].covariance, frames[4]), rtol=1e-9)
    drift = frames[3].covariance - 0.3**2 * plain[3].motion.covariance
    for frame in frames[4:]:
        Ad = adjoint(np.linalg.inv(frame.motion.T_target_source))
        drift = Ad @ drift @ Ad.T
    classical, way_m = plain[5].motion.covariance, np.linalg.norm(frames[5].motion.T_target_source[:3, 3])
    step = way_m * (0.05**2 * classical + np.diag([0, 0, 0, 0.01**2, 0, 0]))
    np.testing.assert_allclose(frames[5].covariance, drift + step + 0.3**2 * classical, rtol=1e-5, atol=1e-12)
