"""`odometry`: two scans in, a pose with covariance and status out."""

import dataclasses
import functools
from typing import Any

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import delo_jax
from delo_jax import inference
from delo_jax.config import DeloConfig
from delo_jax.errors import ScanError
from delo_jax.geometry import se3
from delo_jax.inference import Estimate, check_pose, odometry, prepare, solve
from delo_jax.model import delo
from delo_jax.uncertainty.status import STATUSES
from tests.fixtures import T_street, errors, narrow_model, simulated_clip, street_points, tiny_model
from tests.oracles import street

START = street.pose(0.4, -0.2, 0.0, yaw_deg=2.0)


def assert_sound(estimate):
    """What every estimate is, whatever went in: a rigid pose in float64, a covariance, a known status."""
    T, covariance = estimate.T_target_source, estimate.covariance
    assert T.shape == (4, 4)
    assert T.dtype == covariance.dtype == np.float64
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])
    assert covariance.shape == (6, 6)
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > 0
    assert np.isfinite(covariance).all()
    assert np.all(estimate.aleatoric + estimate.epistemic <= np.diag(covariance) * (1 + 1e-12))  # what is missing is the expected error's
    assert estimate.status in STATUSES
    assert 0.0 <= estimate.confidence <= 1.0
    assert bool(estimate.reason) == (estimate.status != "ok")


def assert_unknown(estimate, T_start):
    """Rejected: the start comes back, with a standard deviation of 30 deg and 5 m."""
    assert_sound(estimate)
    assert estimate.status == "rejected"
    np.testing.assert_array_equal(estimate.T_target_source, T_start)
    sigma = np.sqrt(np.diag(estimate.covariance))
    np.testing.assert_allclose(sigma, [*np.radians([30.0] * 3), 5.0, 5.0, 5.0])


def as_bytes(estimate):
    return b"".join(np.asarray(value).tobytes() for value in dataclasses.astuple(estimate))


def test_a_pair_without_points_compiles_everything_that_a_good_one_needs():
    """Oracle: the sizes of the caches, with the released weights, which are calibrated."""
    params, nothing = delo_jax.load("delo-base"), np.zeros((0, 3), np.float32)
    functions: tuple[Any, ...] = (inference.encode, inference.solve, inference.pair_covariance)
    assert odometry(params, nothing, nothing).status == "rejected"
    sizes = [function._cache_size() for function in functions]
    estimate = odometry(params, *(street.scan(street.pose(x), noise_m=0.02, seed=2).points for x in (0.0, 0.4)))
    assert_sound(estimate)
    assert estimate.status != "rejected"
    assert [function._cache_size() for function in functions] == sizes


def test_untrained_network_comes_near_on_a_simulated_pair():
    """Oracle: simulator truth. Default config, random weights, 0.75 m apart: within half a metre."""
    clip = simulated_clip()
    T_true = np.linalg.inv(clip[1].T_world_lidar) @ clip[0].T_world_lidar
    model = jax.jit(functools.partial(delo.init, DeloConfig()))(jax.random.key(0))
    estimate = odometry(model, clip[0].points, clip[1].points)
    assert_sound(estimate)
    assert estimate.status != "rejected"
    assert errors(np.eye(4), T_true)[0] > 0.7
    assert errors(estimate.T_target_source, T_true)[0] < 0.5


def test_pose_maps_the_source_into_the_target():
    """Oracle: the poses of the analytic street; the target is 1.2 m ahead, so source points move back."""
    forward = odometry(tiny_model(), street_points(0), street_points(1))
    backward = odometry(tiny_model(), street_points(1), street_points(0))
    for estimate, T_true in ((forward, T_street()), (backward, np.linalg.inv(T_street()))):
        assert_sound(estimate)
        assert errors(estimate.T_target_source, T_true)[0] < 0.4
    assert forward.T_target_source[0, 3] < -0.8
    assert backward.T_target_source[0, 3] > 0.8


def test_order_of_the_calls_does_not_matter():
    """Oracle: repetition; every pair gives the same bytes whatever was asked before, and in any dtype that holds the points."""
    pairs = [(a, b, start) for a in (0, 1) for b in (0, 1) for start in (None, START)]

    def ask(k):
        source, target, start = pairs[k]
        return as_bytes(odometry(tiny_model(), street_points(source), street_points(target), T_target_source_init=start))

    in_order = {k: ask(k) for k in range(len(pairs))}
    shuffled = {k: ask(k) for k in np.random.default_rng(0).permutation(len(pairs))}
    assert shuffled == in_order
    copies = [street_points(frame).astype(np.float64) for frame in (0, 1)]
    assert as_bytes(odometry(tiny_model(), *copies)) == in_order[2]


def test_start_is_one_of_two_hypotheses():
    """Oracle: the poses of the street; from a good start the untrained network lands nearer than 25 cm."""
    estimate = odometry(tiny_model(), street_points(0), street_points(1), T_target_source_init=T_street())
    assert errors(estimate.T_target_source, T_street())[0] < 0.25


NOTHING = {
    "empty": np.zeros((0, 3)),
    "one point": np.ones((1, 3)) * 5,
    "ten points": np.random.default_rng(0).uniform(4, 5, (10, 3)),
    "all equal": np.full((500, 3), 6.0),
    "NaN": np.full((500, 3), np.nan),
    "infinite": np.full((500, 3), -np.inf),
    "huge": np.random.default_rng(0).normal(size=(500, 3)) * 1e30,
}


@pytest.mark.parametrize("name", NOTHING)
@pytest.mark.parametrize("side", ["source", "target"])
def test_useless_scan_is_rejected(name, side):
    """Oracle: the documented answer to a scan without surfaces, on either side, from any start."""
    scans = [NOTHING[name], street_points(1)] if side == "source" else [street_points(0), NOTHING[name]]
    estimate = odometry(tiny_model(), *scans)
    assert_unknown(estimate, np.eye(4))
    assert estimate.reason.startswith(f"{side} has ")
    assert estimate.confidence == 0.0
    assert_unknown(odometry(tiny_model(), *scans, T_target_source_init=START), START)


def test_ruined_weights_are_rejected():
    """Oracle: the documented answer to a solver that returns no numbers."""
    model = jax.tree.map(lambda leaf: np.full_like(leaf, np.nan), tiny_model())
    estimate = odometry(model, street_points(0), street_points(1), T_target_source_init=START)
    assert_unknown(estimate, START)
    assert estimate.reason == "the solver found no pose: its matches determine none"


def test_open_plane_holds_no_horizontal_motion():
    """Oracle: geometry; all normals of a flat field are vertical."""
    fields = [street.scan(street.pose(x), boxes=[], noise_m=0.005, seed=k).points for k, x in enumerate((0.0, 1.0))]
    estimate = odometry(tiny_model(), *fields)
    assert_sound(estimate)
    assert estimate.status == "degenerate"
    assert "holds yaw, forward, lateral (" in estimate.reason
    assert np.diag(estimate.covariance)[[3, 4]].min() > 0.9 * 5.0**2  # as unknown as if nobody had measured
    assert np.diag(estimate.covariance)[2] > 0.9 * (5.0 / 15.0) ** 2


def test_exact_pose_has_no_uncertainty():
    """Oracle: by hand."""
    estimate = Estimate.exact(START)
    assert (estimate.status, estimate.confidence, estimate.reason) == ("ok", 1.0, "")
    np.testing.assert_array_equal(estimate.T_target_source, START)
    assert not any(array.any() for array in (estimate.covariance, estimate.aleatoric, estimate.epistemic))


def test_estimates_are_compared_by_identity():
    """Oracle: the language; arrays have no single truth value, so neither equality nor a hash may look at them."""
    one, other = Estimate.exact(np.eye(4)), Estimate.exact(np.eye(4))
    assert one == one
    assert one != other
    assert len({one, other}) == 2


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((50, 4)), r"expected an array of shape \(n, 3\) in metres, got shape \(50, 4\); pass points\[:, :3\]"),
        (np.zeros(30), r"got shape \(30,\)"),
        ([], r"got shape \(0,\)"),
        ([[1.0, 2.0, 3.0], [4.0, 5.0]], "got rows of different lengths"),
        (np.zeros((50, 3), bool), "expected numbers, got dtype bool"),
        (np.full((50, 3), "x"), "expected numbers, got dtype <U1"),
    ],
)
def test_wrong_shape_or_dtype_is_one_sentence(points, message, side):
    """Oracle: the sentence, written by hand."""
    scans = [points, street_points(1)] if side == 0 else [street_points(0), points]
    with pytest.raises(ScanError, match=message):
        odometry(tiny_model(), *scans)


@pytest.mark.parametrize(
    ("T", "message"),
    [
        ([[1.0], [2.0, 3.0]], r"T_target_source_init: expected a \(4, 4\) pose, got "),
        (np.full((4, 4), "a"), r"T_target_source_init: expected a \(4, 4\) pose, got "),
        (np.eye(3), r"T_target_source_init: expected a \(4, 4\) pose, got shape \(3, 3\)"),
        (np.diag([2.0, 1.0, 1.0, 1.0]), "expected a rigid transformation"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "expected a rigid transformation"),
        (np.diag([1.0, 1.0, 1.0, 2.0]), "expected a rigid transformation"),
        (np.full((4, 4), np.nan), "expected a rigid transformation"),
        (street.pose(np.inf), "expected a rigid transformation"),
    ],
)
def test_start_must_be_a_rigid_transformation(T, message):
    """Oracle: the definition of SE(3): orthonormal, right-handed, finite, last row 0 0 0 1."""
    with pytest.raises(ScanError, match=message):
        odometry(tiny_model(), street_points(0), street_points(1), T_target_source_init=T)


def test_start_may_be_a_list():
    """Oracle: the same numbers."""
    np.testing.assert_array_equal(check_pose(START.tolist()), START)


def test_inverse_carries_the_covariance():
    """Oracle: Monte Carlo. 200,000 poses scattered as the estimate says, inverted one by one; correlations to 2 %."""
    variances = np.array([1e-5, 2e-5, 4e-5, 1e-3, 2e-3, 5e-4])
    T = street.pose(3.0, -1.0, 0.2, yaw_deg=25.0, pitch_deg=4.0)
    known = {"aleatoric": 0.25 * variances, "epistemic": 0.75 * variances}
    estimate = Estimate(T_target_source=T, covariance=np.diag(variances), status="ok", confidence=0.8, reason="", **known)
    inverse = estimate.inverted()
    np.testing.assert_allclose(inverse.T_target_source, np.linalg.inv(T), atol=1e-12)
    noise = np.random.default_rng(0).normal(size=(200_000, 6)) * np.sqrt(variances)
    apart = T @ np.linalg.inv(T @ se3.exp(noise))
    samples = np.hstack([Rotation.from_matrix(apart[:, :3, :3]).as_rotvec(), apart[:, :3, 3]])
    scale = np.sqrt(np.outer(np.diag(inverse.covariance), np.diag(inverse.covariance)))
    np.testing.assert_allclose(np.cov(samples.T) / scale, inverse.covariance / scale, atol=0.02)
    np.testing.assert_allclose(inverse.aleatoric, 0.25 * np.diag(inverse.covariance), rtol=1e-9)
    np.testing.assert_allclose(inverse.epistemic, 0.75 * np.diag(inverse.covariance), rtol=1e-9)
    again = inverse.inverted()
    np.testing.assert_allclose(again.covariance, np.diag(variances), atol=1e-12)
    assert (inverse.status, inverse.confidence, inverse.reason) == ("ok", 0.8, "")


def held(model):
    """The model with status limits that geometry never crosses, so that the evidence alone decides."""
    limits = dataclasses.replace(model.cfg.status, min_points=10, min_observability=0.0, rejected_confidence=0.0)
    return delo.Model(model.variables, dataclasses.replace(model.cfg, status=limits))


def test_network_without_a_head_says_that_it_knows_nothing():
    """Oracle: the documented answer; never ok, 30 deg and 5 m, and a sentence; the pose is the network's all the same."""
    estimate = odometry(held(narrow_model("dcp")), street_points(0), street_points(1), T_target_source_init=START)
    assert_sound(estimate)
    assert estimate.status == "low_confidence"
    assert estimate.reason == "this network has no evidence head: nothing says how far its pose can be trusted"
    assert estimate.confidence == 0.0
    np.testing.assert_allclose(np.sqrt(np.diag(estimate.covariance)), [*np.radians([30.0] * 3), 5.0, 5.0, 5.0])
    assert not np.allclose(estimate.T_target_source, START)


@pytest.mark.parametrize("preset", ["paper", "official"])
def test_published_network_stands_however_unsure(monkeypatch, preset):
    """Oracle: the solver's own pose; the paper leaves no pose out by its confidence, which says what the pose graph may take."""
    model = narrow_model(preset)
    limits = dataclasses.replace(model.cfg.status, min_points=10, min_observability=0.0)
    model = delo.Model(model.variables, dataclasses.replace(model.cfg, status=limits))
    monkeypatch.setattr(inference, "solve", lambda *args: solve(*args)._replace(confidence=np.float32(0.0)))
    estimate = odometry(model, street_points(0), street_points(1), T_target_source_init=START)
    assert (estimate.status, estimate.confidence) == ("low_confidence", 0.0)
    found = solve(model, *(prepare(model, street_points(frame)).encoding for frame in (0, 1)), START.astype(np.float32))
    np.testing.assert_allclose(estimate.T_target_source, found.T_target_source, atol=1e-5)


def test_evidence_of_embeddings_becomes_a_covariance():
    """Oracle: Monte Carlo. Poses drawn as independent angles and translations of the head's variances, relative to the estimate.

    Variances to 3 %; the covariance is symmetric, positive definite and not below that of the draws.
    """
    model = held(narrow_model("paper"))  # `official` has the same head
    estimate = odometry(model, street_points(0), street_points(1))
    assert_sound(estimate)
    assert estimate.status in ("ok", "low_confidence")
    encoded = [prepare(model, street_points(frame)).encoding for frame in (0, 1)]
    found = solve(model, *encoded, np.eye(4, dtype=np.float32))
    _, nu, alpha, beta = (np.asarray(value, np.float64) for value in found.nig)
    T = np.asarray(found.T_target_source, np.float64)
    angles = Rotation.from_matrix(T[:3, :3]).as_euler("XYZ")
    aleatoric, epistemic = beta / (alpha - 1), beta / (nu * (alpha - 1))
    shrink = 1e-4  # of the variances, so that no angle is folded
    noise = np.random.default_rng(0).normal(size=(200_000, 6)) * np.sqrt(shrink * (aleatoric + epistemic))
    R = Rotation.from_euler("XYZ", angles + noise[:, :3]).as_matrix()
    apart = np.hstack([Rotation.from_matrix(T[:3, :3].T @ R).as_rotvec(), noise[:, 3:] @ T[:3, :3]])
    spread = np.cov(apart.T) / shrink
    np.testing.assert_allclose(estimate.aleatoric + estimate.epistemic, np.diag(spread), rtol=0.03)
    scale = np.sqrt(np.outer(np.diag(spread), np.diag(spread)))
    assert np.linalg.eigvalsh((estimate.covariance - spread) / scale).min() > -0.05  # the square of the expected error is in it too
    expected = np.clip(1.0 - epistemic.max(), 0.0, 1.0)
    np.testing.assert_allclose(estimate.confidence, expected, atol=1e-4)
