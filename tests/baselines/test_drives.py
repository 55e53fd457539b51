import numpy as np
import pytest
from scipy.linalg import expm, logm

from delo_jax.baselines.prediction import MEAN_VELOCITY
from delo_jax.baselines.protocols import Aligned, PairMethod, ScanToScan
from delo_jax.baselines.registry import METHODS
from delo_jax.errors import ScanError
from delo_jax.pipeline.baseline_odometry import BaselineOdometry
from tests.fixtures import errors
from tests.oracles import street

PERIOD_S = 0.1
VELOCITY = np.array([0.0, 0.0, 0.15, 5.0, 0.0, 0.0])  # of the drive, rad/s and m/s
NUM_STILL = 2  # scans at the beginning that are measured at once: nobody knows a motion to undo
OFFSETS_S = 0.03 * np.array([0.0, 0.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0])  # stamps from the middles of the sweeps
PACKAGES = {"kiss-icp": "kiss_icp", "genz-icp": "genz_icp", "vgicp": "small_gicp", "gicp": "small_gicp", "constant-velocity": "small_gicp"}
PACKAGES["kiss-matcher"] = "kiss_matcher"
# of a motion [m, deg], about twice what each is off by on a sensor of 32 rings with 1 cm of noise; without de-skew all are off by 0.3 m
BOUNDS = {"kiss-icp": (0.2, 0.3), "genz-icp": (0.12, 0.3), "vgicp": (0.01, 0.05), "gicp": (0.01, 0.08), "point-to-plane": (0.03, 0.1)}


def odometry(name, **options):
    """A method along a drive; skips where its package is not installed."""
    if name in PACKAGES:
        pytest.importorskip(PACKAGES[name], reason="a peer's package is not installed: pip install 'delo-jax[baselines]'")
    return BaselineOdometry(METHODS[name].open_tracker(), **options)


def generator(twist):
    """(4, 4) of a twist [omega, v]."""
    (wx, wy, wz), v = twist[:3], twist[3:]
    return np.vstack([np.column_stack([[[0, -wz, wy], [wz, 0, -wx], [-wy, wx, 0]], v]), np.zeros(4)])


def moved(twist):
    """Pose of a twist by SciPy."""
    return expm(generator(twist))


@pytest.fixture(scope="module")
def drive():
    """(points, times relative to the stamp, stamp, pose at the stamp) along the street, as measured by a turning sensor."""
    scans = []
    for k, offset_s in enumerate(OFFSETS_S):
        T_middle = street.pose(-12.0) @ moved(k * PERIOD_S * VELOCITY)
        points = street.scan(T_middle, noise_m=0.01, seed=k, num_columns=600).points.astype(np.float64)
        times_s = PERIOD_S * np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)  # relative to the middle
        if k >= NUM_STILL:  # a point that stands still is seen from where the sensor is at its time: instants 8 mm apart do
            instants = np.linspace(-0.5, 0.5, 65) * PERIOD_S
            nearest = np.rint(64 * (times_s / PERIOD_S + 0.5)).astype(int)
            back = np.array([moved(-instant * VELOCITY) for instant in instants])[nearest]
            points = np.einsum("nij,nj->ni", back[:, :3, :3], points) + back[:, :3, 3]
        stamp_ns = round(1e9 * (k * PERIOD_S + offset_s)) + 10**9
        scans.append((points.astype(np.float32), times_s - offset_s, stamp_ns, T_middle @ moved(offset_s * VELOCITY)))
    return scans


@pytest.mark.parametrize("name", list(BOUNDS))
def test_the_pose_is_that_of_the_stamp(name, drive):
    """Oracle: the poses that the scans were ray-cast from; stamps are now before, now after the middle of their sweep."""
    tracked = odometry(name)
    frames = [tracked.register(points, stamp_ns, times_s) for points, times_s, stamp_ns, _ in drive]
    found = np.array([frame.T_world_lidar for frame in frames])
    for k in range(4, len(drive)):
        error_m, error_deg = errors(np.linalg.inv(found[k - 1]) @ found[k], np.linalg.inv(drive[k - 1][3]) @ drive[k][3])
        assert error_m < BOUNDS[name][0], k
        assert error_deg < BOUNDS[name][1], k
    assert [frame.status for frame in frames].count("rejected") == 0
    assert [frame.since for frame in frames] == [0, *range(len(drive) - 1)]


def test_frames_without_uncertainty(drive):
    """Oracle: NaN, and the motion as the quotient of two poses."""
    tracked = odometry("point-to-plane")
    frames = [tracked.register(points, stamp_ns) for points, _, stamp_ns, _ in drive[:2]]
    for frame in frames:
        known = (frame.covariance, frame.local, frame.motion.covariance, frame.motion.aleatoric, frame.motion.epistemic)
        assert all(np.isnan(array).all() for array in known)
        assert np.isnan(frame.motion.confidence)
    quotient = np.linalg.inv(frames[0].T_world_lidar) @ frames[1].T_world_lidar
    np.testing.assert_allclose(frames[1].motion.T_target_source, quotient, atol=1e-12)
    assert np.array_equal(tracked.trajectory().stamps_ns, [stamp_ns for _, _, stamp_ns, _ in drive[:2]])


def test_the_mean_motion_and_none_along_a_drive(drive):
    """Oracle: SciPy's exponential of the mean velocity over the time between stamps, and the identity."""
    times = [stamp_ns for _, _, stamp_ns, _ in drive]
    mean, still = odometry("mean-motion"), odometry("identity")
    for points, _, stamp_ns, _ in drive:
        last, stands = mean.register(points, stamp_ns), still.register(points, stamp_ns)
    np.testing.assert_allclose(last.T_world_lidar, moved(1e-9 * (times[-1] - times[0]) * MEAN_VELOCITY), atol=1e-9)
    assert np.array_equal(stands.T_world_lidar, np.eye(4))


def test_the_first_motion_goes_on(drive):
    """Oracle: SciPy's logarithm of that motion, times the time that has passed; the truth of the first motion."""
    times = [stamp_ns for _, _, stamp_ns, _ in drive]
    constant = odometry("constant-velocity")
    poses = [constant.register(points, stamp_ns).T_world_lidar for points, _, stamp_ns, _ in drive]
    velocity = np.real(logm(poses[1])) / (times[1] - times[0])
    np.testing.assert_allclose(poses[-1], expm(velocity * (times[-1] - times[0])), atol=1e-6)
    assert errors(poses[1], np.linalg.inv(drive[0][3]) @ drive[1][3])[0] < 0.05


def test_a_bad_scan_is_carried(drive):
    """Oracle: constant velocity by SciPy; the motion after it spans the gap."""
    tracked = odometry("point-to-plane", deskew=False)
    still = [street.scan(street.pose(0.4 * k), noise_m=0.01, seed=k).points for k in range(4)]
    frames = [tracked.register(still[0]), tracked.register(still[1])]
    frames += [tracked.reject("it could not be read"), tracked.register(still[0][:5]), tracked.register(still[3] * [1.0, 1.0, 1.0])]
    velocity = np.real(logm(frames[1].T_world_lidar))
    assert [frame.status for frame in frames] == ["ok", "ok", "rejected", "rejected", "ok"]
    np.testing.assert_allclose(frames[2].T_world_lidar, expm(2 * velocity), atol=1e-8)
    np.testing.assert_allclose(frames[3].T_world_lidar, expm(3 * velocity), atol=1e-8)
    assert [frame.since for frame in frames] == [0, 0, 1, 1, 1]
    assert errors(frames[4].T_world_lidar, street.pose(1.2, z=0.0))[0] < 0.03
    assert np.isnan(frames[2].covariance).all()
    assert frames[3].motion.reason.startswith("5 usable points")


def test_a_stamp_or_times_that_do_not_fit_change_nothing(drive):
    """Oracle: the next scan is taken as if they had never come."""
    tracked = odometry("identity")
    points, times_s, stamp_ns, _ = drive[0]
    tracked.register(points, stamp_ns, times_s)
    with pytest.raises(ScanError, match="expected more than the last stamp"):
        tracked.register(points, stamp_ns, times_s)
    with pytest.raises(ScanError, match="one time per point"):
        tracked.register(points, stamp_ns + 1, times_s[1:])
    assert tracked.register(points, stamp_ns + 1, times_s).since == 0
    assert len(tracked.trajectory()) == 2


class _Always(PairMethod):
    """A pair method with one answer."""

    def __init__(self, answer):
        self._answer = answer

    def align(self, source, target, T_target_source_init):
        return self._answer


def test_times_that_are_no_numbers_undo_nothing(drive):
    """Oracle: the same scans without times."""
    plain, odd = odometry("point-to-plane"), odometry("point-to-plane")
    for points, times_s, stamp_ns, _ in drive[:3]:
        expected = plain.register(points, stamp_ns)
        frame = odd.register(points, stamp_ns, np.full(len(times_s), np.nan))
    np.testing.assert_allclose(frame.T_world_lidar, expected.T_world_lidar, atol=1e-4)  # a turn by nothing rounds


def test_a_method_that_finds_nothing_goes_on_by_constant_velocity(drive):
    """Oracle: the identity, which is what is expected before any motion."""
    nothing = Aligned.of(np.eye(4), "no solution", status="rejected")
    tracked = BaselineOdometry(ScanToScan(_Always(nothing)))
    frames = [tracked.register(points, stamp_ns) for points, _, stamp_ns, _ in drive[:3]]
    assert [frame.status for frame in frames] == ["ok", "low_confidence", "low_confidence"]
    assert np.array_equal(frames[-1].T_world_lidar, np.eye(4))
    assert frames[-1].motion.reason == "no solution; carried on by constant velocity"


def test_a_pose_that_is_not_a_number_is_rejected(drive):
    """Oracle: the identity, which is what is expected before any motion; the frames stay finite."""
    tracked = BaselineOdometry(METHODS["identity"].open_tracker())
    tracked.register(*drive[0][:1])
    tracked._tracker = _Broken()
    frame = tracked.register(*drive[1][:1])
    assert frame.status == "rejected"
    assert np.array_equal(frame.T_world_lidar, np.eye(4))


class _Broken:
    """A tracker whose poses are not numbers."""

    deskews = True

    def track(self, sweep, T_last_guess):
        return Aligned.of(np.full((4, 4), np.nan))
