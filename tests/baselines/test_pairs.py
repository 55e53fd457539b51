import numpy as np
import pytest
from scipy.linalg import expm

import delo_jax
from delo_jax.baselines.icp import NUM_MOVED, Icp
from delo_jax.baselines.network import Network
from delo_jax.baselines.prediction import MEAN_VELOCITY
from delo_jax.baselines.protocols import MIN_POINTS
from delo_jax.baselines.registry import METHODS
from delo_jax.errors import ScanError
from delo_jax.model.delo import Model
from delo_jax.sim.motion import make_motion, pose_at
from delo_jax.train.presets import PRESETS
from tests.fixtures import T_street, errors, narrow_model, street_points
from tests.oracles import street

PACKAGES = {"gicp": "small_gicp", "vgicp": "small_gicp", "kiss-matcher": "kiss_matcher"}
# [m, deg], about twice what each is off by on a sensor of 32 rings with 1 cm of noise
BOUNDS = {"icp": (0.1, 1.0), "point-to-plane": (0.02, 0.1), "gicp": (0.02, 0.1), "vgicp": (0.02, 0.05), "kiss-matcher": (0.2, 2.0)}


def pair_method(name):
    """A pair method; skips where its package is not installed."""
    if name in PACKAGES:
        pytest.importorskip(PACKAGES[name], reason="a peer's package is not installed: pip install 'delo-jax[baselines]'")
    return METHODS[name].open_pair()


@pytest.mark.parametrize("name", list(BOUNDS))
def test_the_pose_of_the_street(name):
    """Oracle: the poses that the scans were ray-cast from, 1.2 m and 3 deg apart, from the identity."""
    found = pair_method(name)(street_points(0), street_points(1))
    error_m, error_deg = errors(found.T_target_source, T_street())
    assert error_m < BOUNDS[name][0]
    assert error_deg < BOUNDS[name][1]
    assert found.status in ("ok", "low_confidence")
    assert (found.status == "ok") == (not found.reason)
    assert np.isnan(found.covariance).all()
    assert found.covariance.shape == (6, 6)


@pytest.mark.parametrize("name", ["icp", "point-to-plane"])
def test_what_is_ours_gives_the_same_bytes_and_no_pose_without_a_match(name):
    """Oracle: a second call; a target a kilometre away, within whose gate nothing lies."""
    method, start = pair_method(name), np.eye(4)
    first, again = (method(street_points(0), street_points(1)) for _ in range(2))
    assert np.array_equal(first.T_target_source, again.T_target_source)
    found = method(street_points(0), street_points(1) + np.float32(1000.0), start)
    assert found.status == "rejected"
    assert "no match" in found.reason
    assert np.array_equal(found.T_target_source, start)


def test_padding_changes_nothing():
    """Oracle: the same few points with more rows beside them, which have no weight."""
    icp, (source, target) = Icp(), (street.scan(street.pose(x), noise_m=0.01, seed=k).points for k, x in enumerate((0.0, 0.4)))
    clouds = icp.prepare(source[::28]), icp.prepare(target)
    assert len(clouds[0].points) < NUM_MOVED
    few = icp.align(*clouds, np.eye(4)).T_target_source
    icp_larger = Icp()
    icp_larger.step = lambda *arrays: Icp.step(*(np.concatenate([array, np.zeros_like(array)]) for array in arrays))
    np.testing.assert_allclose(icp_larger.align(*clouds, np.eye(4)).T_target_source, few, atol=2e-5)  # sums in another order


def test_predictions_need_no_points():
    """Oracle: SciPy's matrix exponential, the identity and the start."""
    scans = street_points(0), street_points(1)
    start = street.pose(0.3, yaw_deg=2.0)
    assert np.array_equal(METHODS["identity"].open_pair()(*scans, start).T_target_source, np.eye(4))
    assert np.array_equal(METHODS["constant-velocity"].pair()(*scans, start).T_target_source, start)
    generator = np.zeros((4, 4))
    generator[0, 3] = -0.1 * MEAN_VELOCITY[3]
    np.testing.assert_allclose(METHODS["mean-motion"].open_pair()(*scans).T_target_source, expm(generator), atol=1e-12)


def test_the_mean_motion_is_that_of_the_simulator():
    """Oracle: motions of the simulator, a third of them turning, of seeds that training uses; their mean speed within 3 standard errors."""
    speeds = []
    for seed in range(400):
        turning = seed % 20 < 7
        Ts = pose_at(make_motion(seed, 0.5, turning=turning, max_speed=15.0 if turning else 30.0), np.array([0.0, 0.1]))
        speeds.append(10.0 * np.linalg.norm(Ts[1, :3, 3] - Ts[0, :3, 3]))
    assert abs(np.mean(speeds) - MEAN_VELOCITY[3]) < 3.0 * np.std(speeds) / np.sqrt(len(speeds))
    assert not MEAN_VELOCITY[[0, 1, 2, 4, 5]].any()


def test_dcp_is_the_network_without_uncertainty():
    """Oracle: `delo_jax.odometry` with the same weights, whose preset has no evidence head."""
    params = narrow_model("dcp")
    found = METHODS["dcp"].open_pair(params)(street_points(0), street_points(1))
    expected = delo_jax.odometry(params, street_points(0), street_points(1))
    assert np.array_equal(found.T_target_source, expected.T_target_source)
    assert found.status == expected.status
    assert np.isnan(found.covariance).all()
    assert isinstance(METHODS["delo-paper"].open_pair(Model({}, PRESETS["paper"].model)), Network)


@pytest.mark.parametrize("bad", ["few", "nan", "origin"])
def test_a_scan_without_points_is_rejected(bad):
    """Oracle: by construction, no usable point or fewer than there have to be; the answer is the start."""
    scan = {"few": street_points(0)[: MIN_POINTS - 1], "nan": np.full((500, 3), np.nan), "origin": np.zeros((500, 3))}[bad]
    start = street.pose(0.5, yaw_deg=1.0)
    found = METHODS["icp"].open_pair()(scan.astype(np.float32), street_points(1), start)
    assert found.status == "rejected"
    assert f"fewer than {MIN_POINTS}" in found.reason
    assert np.array_equal(found.T_target_source, start)


def test_wrong_shapes_are_refused():
    """Oracle: the sentence of the package's other front doors."""
    with pytest.raises(ScanError, match="source: expected an array of shape"):
        METHODS["identity"].open_pair()(np.zeros((5, 4)), street_points(1))
    with pytest.raises(ScanError, match="expected a rigid transformation"):
        METHODS["identity"].open_pair()(street_points(0), street_points(1), np.diag([2.0, 1, 1, 1]))
