"""Presets at full size beside their PyTorch twin: how far they are apart. Import it only after `pytest.importorskip("torch")`."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from delo_jax import config, preprocess
from delo_jax.model import delo
from delo_jax.train.presets import PRESETS
from tests.oracles.published import NUM_POINTS, PublishedDelo, load
from tests.oracles.weights import RANDOM

FLOORS = {"nu": 1e-3, "alpha": 1e-3, "beta": 1e-6}  # ours alone: they keep divisors and a logarithm away from zero
# What the twin does for each preset; the code's slack of 1e-6 in divisions by row sums is left out, see `barycentric_projection`.
CALLS = {
    "official": {"head": "transport", "mass": 1.0},
    "dcp": {"head": "pointer"},
    "paper": {"head": "dykstra", "mass": 0.1},
}
LAST_NORMS = {"official": 0.1, "dcp": 0.1, "paper": 0.3}  # with random weights, scores over a row then range over 5 units


def street_pair(seed, num=NUM_POINTS):
    """Two sparse clouds over tens of metres; the target is the moved source with other noise, in another order."""
    rng = np.random.default_rng(seed)
    source = rng.normal(scale=[20.0, 15.0, 2.0], size=(num, 3))
    R = Rotation.from_euler("XYZ", [0.5, -0.4, 3.0], degrees=True).as_matrix()
    target = source @ R.T + [1.3, 0.1, -0.02] + rng.normal(scale=0.05, size=(num, 3))
    return source.astype(np.float32), rng.permutation(target).astype(np.float32)


def random_weights(cfg: config.DeloConfig, seed=0, last_norms=0.1) -> delo.Model:
    """A model with nothing left at zero or one; its last norms are small, so that scores are a few units and the plan is soft.

    The transport's weight is left where it starts: epsilon = 1.
    """
    rng = np.random.default_rng(seed)

    def draw(path, leaf):
        name = path[-1].key
        if name == "raw_epsilon":
            return jnp.log(jnp.expm1(jnp.asarray(0.99)))  # softplus of it, plus the floor of 0.01, is 1
        array = RANDOM[name](rng, leaf.shape).astype(np.float32)
        last = any(key.key == "norm_out" for key in path) or [key.key for key in path[-3:-1]] == ["decoder", "norm"]
        return jnp.asarray(last_norms * array if last and path[0].key == "params" else array)

    shapes = jax.eval_shape(lambda key: delo.init(cfg, key).variables, jax.random.key(0))
    return delo.Model(jax.tree_util.tree_map_with_path(draw, shapes), cfg)


def constrained(raw) -> dict[str, np.ndarray]:
    """The code's normal-inverse-gamma parameters of 24 raw numbers, with our floors."""
    gamma, *rest = np.split(np.asarray(raw), 4)
    nu, alpha, beta = (np.logaddexp(0.0, part) for part in rest)
    return {"gamma": gamma, "nu": nu + FLOORS["nu"], "alpha": 1.0 + alpha + FLOORS["alpha"], "beta": beta + FLOORS["beta"]}


def compare(preset: str, seed: int = 0) -> dict[str, float]:
    """Largest difference between a preset at full size and its twin, as a share of the largest value of the twin's tensor.

    Both see the same clouds and random weights. Ours goes from points to pose through `preprocess`, `encode`, `match` and
    `solve`, chained in float32; the twin is float64 and hands on its own results.
    """
    cfg = PRESETS[preset].model
    model = random_weights(cfg, seed, LAST_NORMS[preset])
    enc = cfg.encoder
    twin = PublishedDelo(relative=enc.edges == "relative", edge_scale=enc.edge_scale_m, position_scale=enc.position_scale_m)
    load(twin, model.variables)
    scans = [preprocess.preprocess(points, cfg.preprocess) for points in street_pair(seed)]
    expected = twin(*(scan.points for scan in scans), **CALLS[preset])
    with jax.default_matmul_precision("highest"):
        source, target = (jax.jit(delo.encode)(model, scan) for scan in scans)
        matching = jax.jit(delo.match)(model, source, target)
        found = jax.jit(delo.solve)(model, source, target, jnp.eye(4))
        scores = model.apply("scores", matching.source, matching.target)
    pairs = {
        "source features": (source.descriptors, expected.source_features),
        "target features": (target.descriptors, expected.target_features),
        "source embeddings": (matching.source, expected.source_embeddings),
        "target embeddings": (matching.target, expected.target_embeddings),
        "scores": (scores, expected.scores),
        "plan": (matching.plan, expected.plan),
        "T_target_source": (found.T_target_source, expected.T_target_source),
    }
    if cfg.evidence.head != "none":
        pairs |= {name: (getattr(found.nig, name), value) for name, value in constrained(expected.raw).items()}
    return {
        name: float(np.abs(np.asarray(ours, np.float64) - theirs).max() / np.abs(theirs).max()) for name, (ours, theirs) in pairs.items()
    }
