"""Bad scans: carried, bridged, and left behind when the last good scan is out of reach."""

import numpy as np
import pytest

from tests.oracles import street
from tests.pipeline.exact_fakes import FEW, SIGMA2, UNKNOWN, ExactNetwork, make, noise, screw, see, winding_road


def test_bad_scans_are_carried_and_bridged():
    """Oracle: the drive at constant velocity. The bad scans' poses are predictions, the next good one is measured across the gap."""
    odometry, network = make()
    frames = [odometry.register(FEW if k in (3, 4) else see(screw(0.1 * k))) for k in range(7)]
    assert [frame.status for frame in frames] == ["ok"] * 3 + ["rejected"] * 2 + ["ok"] * 2
    assert [frame.since for frame in frames] == [0, 0, 1, 2, 2, 2, 5]
    for k, frame in enumerate(frames):
        np.testing.assert_allclose(frame.T_world_lidar, screw(0.1 * k), atol=1e-3)
    source, target = network.pairs[-2]
    np.testing.assert_array_equal(source, see(screw(0.2)))
    np.testing.assert_array_equal(target, see(screw(0.5)))
    np.testing.assert_allclose(network.starts[-2], screw(-0.3), atol=1e-4)  # predicted over all three steps
    np.testing.assert_allclose(frames[5].motion.T_target_source, screw(0.3), atol=2e-5)


def test_a_scan_of_noise_does_not_break_the_bridge():
    """Oracle: the drive at constant velocity; noise has points enough to become a source, and must not."""
    odometry, _ = make(ExactNetwork(reach_m=15.0))
    frames = [odometry.register(noise(k) if k in (3, 6, 7) else see(screw(0.1 * k))) for k in range(10)]
    assert [frame.status for frame in frames] == ["ok"] * 3 + ["rejected"] + ["ok"] * 2 + ["rejected"] * 2 + ["ok"] * 2
    assert [frame.since for frame in frames] == [0, 0, 1, 2, 2, 4, 5, 5, 5, 8]
    for k, frame in enumerate(frames):
        np.testing.assert_allclose(frame.T_world_lidar, screw(0.1 * k), atol=2e-3)
    np.testing.assert_allclose(frames[4].motion.T_target_source, screw(0.2), atol=2e-5)
    np.testing.assert_allclose(frames[9].covariance.diagonal().max(), 7 * SIGMA2.max(), rtol=0.2)  # seven measured pairs, no guess


@pytest.mark.parametrize("kind", ["unreadable", "empty", "noise"])
def test_outage_beyond_reach_ends_with_two_good_scans(kind):
    """Oracle: the trajectory the scans were seen from. 20 bad scans; the car is then 22 m from the last good one, and has braked.

    The first good scan fits nothing, the second fits the first: from there on every motion is exact again, in a world that is off by
    what the prediction over the outage was off.
    """
    odometry, _ = make(ExactNetwork(reach_m=15.0))
    for k in range(4):
        odometry.register(see(screw(0.1 * k)))
    bad = {"unreadable": lambda k: odometry.reject("unreadable"), "empty": lambda k: odometry.register(FEW)}
    lost = [bad.get(kind, lambda k: odometry.register(noise(k)))(k) for k in range(20)]
    truth = [screw(0.3) @ street.pose(22.0, 1.0, 0.0, yaw_deg=15.0) @ T for T in winding_road(6)]
    frames = [odometry.register(see(T)) for T in truth]
    assert {frame.status for frame in lost} == {"rejected"}
    assert [frame.status for frame in frames] == ["rejected"] + ["ok"] * 5
    assert [frame.since for frame in frames] == [3, 24, 25, 26, 27, 28]
    for k in range(1, 6):
        step = np.linalg.inv(truth[k - 1]) @ truth[k]
        np.testing.assert_allclose(frames[k].motion.T_target_source, step, atol=5e-5)
        np.testing.assert_allclose(np.linalg.inv(frames[k - 1].T_world_lidar) @ frames[k].T_world_lidar, step, atol=5e-5)
        np.testing.assert_allclose(np.diag(frames[k].motion.covariance)[3:].max(), SIGMA2.max(), rtol=0.2)
        assert np.diag(frames[k].covariance)[3:].min() > (21 * 5.0) ** 2  # the world's pose stays as doubtful as the outage left it
    np.testing.assert_allclose(frames[0].T_world_lidar, screw(0.3 + 2.1), atol=5e-3)  # predicted


def test_noise_as_the_first_scan():
    """Oracle: the trajectory, seen from its first pose on, wherever that lies in the world of the noise."""
    odometry, _ = make()
    truth = winding_road(4)
    frames = [odometry.register(points) for points in (noise(0), *(see(T) for T in truth))]
    assert [frame.status for frame in frames] == ["ok", "rejected", "ok", "ok", "ok"]
    assert [frame.since for frame in frames] == [0, 0, 1, 2, 3]
    for frame, T in zip(frames[1:], truth, strict=True):
        np.testing.assert_allclose(np.linalg.inv(frames[1].T_world_lidar) @ frame.T_world_lidar, T, atol=1e-4)


def test_covariance_grows_while_nobody_measures():
    """Oracle: by hand. Standard deviations are 1, 2, 3 times those of an unknown pose; one good pair ends it."""
    odometry, _ = make()
    standing = see(np.eye(4))
    frames = [odometry.register(points) for points in (standing, standing, FEW, FEW)]
    frames += [odometry.reject("file is truncated"), odometry.register(standing)]
    for count, frame in enumerate(frames[2:5], start=1):
        np.testing.assert_allclose(frame.motion.covariance, count**2 * np.diag(UNKNOWN), rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(frame.covariance, np.diag(count**2 * UNKNOWN + SIGMA2), rtol=1e-4, atol=1e-12)
        np.testing.assert_allclose(frame.motion.aleatoric + frame.motion.epistemic, count**2 * UNKNOWN, rtol=1e-6)
    assert frames[4].motion.reason == "file is truncated"
    assert (frames[4].status, frames[4].motion.confidence) == ("rejected", 0.0)
    np.testing.assert_allclose(frames[5].covariance, np.diag(2 * SIGMA2), rtol=1e-4, atol=1e-12)


def test_world_is_the_first_good_scan():
    """Oracle: the trajectory, seen from its second pose on."""
    odometry, _ = make()
    truth = winding_road(5)
    frames = [odometry.reject("unreadable"), odometry.register(FEW), *(odometry.register(see(T)) for T in truth[1:])]
    assert [frame.status for frame in frames] == ["rejected", "rejected", "ok", "ok", "ok", "ok"]
    assert frames[1].motion.reason == "the first scan has 3 usable points, fewer than 20"
    np.testing.assert_allclose(frames[1].motion.covariance, 4 * np.diag(UNKNOWN))
    for frame, T in zip(frames[2:], truth[1:], strict=True):
        np.testing.assert_allclose(frame.T_world_lidar, np.linalg.inv(truth[1]) @ T, atol=1e-4)
    np.testing.assert_array_equal(frames[2].covariance, np.zeros((6, 6)))


def test_rejected_frame_follows_the_motion_model():
    """Oracle: scipy's expm at the stamp of the unreadable scan."""
    odometry, _ = make()
    for time in (0.0, 0.1):
        odometry.register(see(screw(time)), stamp_ns=round(time * 1e9))
    frame = odometry.reject("unreadable", stamp_ns=350_000_000)
    np.testing.assert_allclose(frame.T_world_lidar, screw(0.35), atol=2e-4)
    assert frame.stamp_ns == 350_000_000
