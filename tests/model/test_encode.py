"""Encoder and embeddings: sizes, padding, symmetry."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from delo_jax.config import DeloConfig
from delo_jax.inference import encode
from delo_jax.model import delo
from delo_jax.ops.knn import knn
from delo_jax.preprocess import preprocess
from tests.fixtures import TINY, dirty, street_points, street_scan, thinned, tiny_model


def turned(scan, yaw):
    """The scan from a sensor turned about its vertical axis."""
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return scan._replace(points=(scan.points @ R.T).astype(np.float32), normals=(scan.normals @ R.T).astype(np.float32))


def dense(num_in, num_out):
    return num_in * num_out + num_out


def test_number_of_weights():
    """Oracle: counted by hand from the layers' sizes at the default config: 11 = normal and features of a key point, 15 edge features."""

    def edge_conv(channels, width=64):
        return channels * width + dense(channels, width) + 3 * width + dense(width, width) + 2 * width  # the last: layer norm

    expected = {
        "encoder": edge_conv(11) + 2 * edge_conv(64) + dense(3 * 64, 128) + dense(128, 64),
        "matcher": 1,
        "point_embedding": dense(8, 32) + dense(32, 16),
        "edge_network": dense(16 + 16 + 15, 32) + dense(32, 32) + dense(32, 2),
        "evidence_head": dense(24, 32) + dense(32, 32) + dense(32, 25),
    }
    shapes = jax.eval_shape(functools.partial(delo.init, DeloConfig()), jax.random.key(0)).variables
    assert shapes.keys() == {"params"}
    assert {name: sum(leaf.size for leaf in jax.tree.leaves(part)) for name, part in shapes["params"].items()} == expected


def test_descriptors_are_unit_vectors_and_zero_in_the_padding():
    """Oracle: the documented form."""
    scan = thinned(street_scan(0), 400, 50)
    encoding = encode(tiny_model(), scan)
    lengths = np.linalg.norm(encoding.descriptors, axis=1)
    np.testing.assert_allclose(lengths, scan.keypoint_mask, atol=1e-5)
    np.testing.assert_array_equal(encoding.keypoints[:50], scan.points[scan.keypoint_index[:50]])
    np.testing.assert_array_equal(encoding.cloud.mask, scan.mask)


def test_padding_changes_nothing():
    """Oracle: symmetry; the same bytes of every valid row, whatever the padded rows hold."""
    scan = thinned(street_scan(0), 300, 40)
    clean, filled = (jax.device_get(encode(tiny_model(), s)) for s in (scan, dirty(scan)))
    assert clean.descriptors.tobytes() == filled.descriptors.tobytes()
    assert clean.cloud.embedding[:300].tobytes() == filled.cloud.embedding[:300].tobytes()
    assert clean.keypoints[:40].tobytes() == filled.keypoints[:40].tobytes()


def test_order_of_key_points_is_theirs():
    """Oracle: symmetry; descriptors move with their key points, up to the order of float32 sums."""
    scan = street_scan(0)
    order = np.random.default_rng(0).permutation(len(scan.keypoint_index))
    shuffled = scan._replace(keypoint_index=scan.keypoint_index[order], keypoint_mask=scan.keypoint_mask[order])
    here, there = (encode(tiny_model(), s).descriptors for s in (scan, shuffled))
    np.testing.assert_allclose(there, here[order], atol=1e-5)


def test_embeddings_do_not_change_when_the_sensor_yaws():
    """Oracle: symmetry, exact; they see the features alone, which are invariant."""
    here, there = (encode(tiny_model(), s).cloud.embedding for s in (street_scan(0), turned(street_scan(0), 0.7)))
    assert np.array_equal(here, there)


def test_descriptors_match_a_loop_in_float64():
    """Oracle: the edge convolutions written out in NumPy, key point by key point."""
    scan = thinned(street_scan(0), 400, 30)
    model = tiny_model()
    found = encode(model, scan).descriptors
    params = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), model.variables["params"]["encoder"])
    kept = scan.keypoint_index[:30]
    points, features = scan.points[kept].astype(np.float64), np.hstack([scan.normals[kept], scan.features[kept]]).astype(np.float64)
    neighbors = [np.argsort(np.linalg.norm(points - p, axis=1))[: TINY.encoder.num_neighbors] for p in points]
    index = np.asarray(knn(jnp.asarray(scan.points[kept]), jnp.ones(30, bool), TINY.encoder.num_neighbors))
    assert [set(row) for row in index] == [set(row) for row in neighbors]
    levels = [features]
    for level in range(3):
        p, norm = params[f"edge_conv_{level}"], params[f"norm_{level}"]
        h = levels[-1]
        rows = []
        for i, near in enumerate(neighbors):
            center = h[i] @ p["center"]["kernel"] + p["center"]["bias"]
            edges = [h[j] @ p["neighbor"]["kernel"] + center + (points[j] - points[i]) / 4.0 @ p["edge"]["kernel"] for j in near]
            hidden = np.maximum(np.array(edges), 0) @ p["out"]["kernel"] + p["out"]["bias"]
            rows.append(np.maximum(hidden.max(axis=0), 0))
        new = np.array(rows)
        new = (new - new.mean(axis=1, keepdims=True)) / np.sqrt(new.var(axis=1, keepdims=True) + 1e-6)
        levels.append(new * norm["scale"] + norm["bias"])
    h = np.maximum(np.hstack(levels[1:]) @ params["hidden"]["kernel"] + params["hidden"]["bias"], 0)
    expected = h @ params["descriptor"]["kernel"] + params["descriptor"]["bias"]
    np.testing.assert_allclose(found[:30], expected / np.linalg.norm(expected, axis=1, keepdims=True), atol=1e-3)


@pytest.mark.parametrize("name", ["empty", "one key point"])
def test_scan_without_points_is_finite(name):
    """Oracle: the documented form; nothing valid, nothing infinite."""
    scan = preprocess(street_points(0)[:0], TINY.preprocess) if name == "empty" else thinned(street_scan(0), 20, 1)
    encoding = encode(tiny_model(), scan)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(encoding))
    assert np.all(encoding.descriptors[1:] == 0)
