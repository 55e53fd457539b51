"""Networks by themselves: those of the presets with the older scan kept, and the paper's beside the same network in PyTorch."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from _peers_drive import Sweep
from _peers_turns import in_turns

from delo_jax import inference
from delo_jax.baselines.protocols import NUM_THREADS
from delo_jax.bench.pair import model_of
from delo_jax.bench.timing import Timing
from delo_jax.config import DeloConfig, EvidenceConfig, MatchingConfig
from delo_jax.model import delo
from delo_jax.preprocess import Scan, preprocess
from delo_jax.train.presets import PRESETS

sys.path.insert(0, str(Path(__file__).parents[1]))  # the twin in PyTorch is a test oracle

BASE, TINY_WIDE, TINY = "base, N = 1024", "tiny, N = 1024", "tiny, N = 256 (its own)"
SOFTMAX, TORCH_SOFTMAX = "JAX, softmax head", "PyTorch, softmax head"
TRANSPORT, TORCH_DENSE = "JAX, transport", "PyTorch, transport by dense N x N diagonal products"
TORCH_SCALED = "PyTorch, transport by scaling rows and columns"
STREAMING = "JAX, transport, streaming: all of the older scan kept"
SCORES_RANGE = 0.3  # of the random weights' last norms: scores over a row then range over 5 units, as with trained weights

ScanPair = tuple[Scan, Scan]


class Ends(NamedTuple):
    """A pair whose older scan has been encoded."""

    source: delo.Encoding
    target: Scan  # newer


def prepared(sweeps: Sequence[tuple[Sweep, Sweep]], cfg: DeloConfig) -> list[ScanPair]:
    """Pairs of scans as the network takes them, the older one first."""
    return [(preprocess(older.points, cfg.preprocess), preprocess(newer.points, cfg.preprocess)) for older, newer in sweeps]


def with_older_encoded(model: delo.Model, scans: Sequence[ScanPair]) -> list[Ends]:
    """The same with all of the older scan computed that needs no other."""
    return [Ends(jax.block_until_ready(inference.encode(model, older)), newer) for older, newer in scans]


def presets(small: bool) -> dict[str, delo.Model]:
    """Networks to be timed alone; random weights for `tiny`, of which there are none: times do not depend on them."""
    found = {TINY: delo.init(PRESETS["tiny"].model, jax.random.key(0))}
    return found if small else {BASE: model_of("base", 1024), TINY_WIDE: model_of("tiny", 1024), **found}


def time_presets(sweeps: Sequence[tuple[Sweep, Sweep]], num: int, warm_up: int, *, small: bool = False) -> dict[str, Timing]:
    """Encoding of the newer scan and solution of the pair (plan, both stages, evidence), from prepared scan to pose on the host."""
    start = jnp.eye(4)

    def call(model: delo.Model) -> Callable[[int], Any]:
        ends = with_older_encoded(model, prepared(sweeps, model.cfg))

        def solve(turn: int) -> np.ndarray:
            source, target = ends[turn % len(ends)]
            return np.asarray(inference.solve(model, source, inference.encode(model, target), start).T_target_source)

        return solve

    return in_turns({name: call(model) for name, model in presets(small).items()}, num, warm_up=warm_up, pause_s=0.0)


def torch_missing() -> str:
    """Why there is no PyTorch, and what to do; empty where there is one."""
    try:
        import torch  # noqa: F401
    except ImportError as error:
        return f"PyTorch: expected it to be installed, got {error}; run pip install '.[parity]'"
    return ""


def paper_models() -> tuple[delo.Model, delo.Model]:
    """The paper's network without its evidence head, with its transport and with DCP's softmax in its place; they share their weights."""
    cfg = replace(PRESETS["paper"].model, evidence=EvidenceConfig(head="none"))
    if torch_missing():
        model = delo.init(cfg, jax.random.key(0))
    else:
        from tests.oracles.parity import random_weights  # fit to be compared: no plan is flat

        model = random_weights(cfg, last_norms=SCORES_RANGE)
    softmax = {name: block for name, block in model.variables["params"].items() if name != "matcher"}
    variables = {**model.variables, "params": softmax}
    return model, delo.Model(variables, replace(cfg, matching=MatchingConfig(plan="softmax", scores="scaled")))


def dense_transport(cost: Any, *, mass: float, num_iters: int) -> Any:
    """The authors' loop as they wrote it: rows and columns capped by products with dense diagonal N x N matrices; epsilon is 1."""
    import torch

    n, m = cost.shape
    plan = torch.exp(-cost)
    plan = plan * mass / plan.sum()
    for _ in range(num_iters):
        plan = torch.diag(torch.clamp((1 / n) / plan.sum(dim=1), max=1.0)) @ plan
        plan = plan @ torch.diag(torch.clamp((1 / m) / plan.sum(dim=0), max=1.0))
        plan = plan * mass / plan.sum()
    return plan


class Twin:
    """The paper's network in PyTorch, in float32 and inference mode, on as many threads as everybody has.

    Args:
        model: ours, whose weights it takes.
    """

    def __init__(self, model: delo.Model):
        import torch

        from tests.oracles import published

        cfg = model.cfg
        self._num_neighbors, self._clipped, self._procrustes = published.NUM_NEIGHBORS, published.clipped_transport, published.procrustes
        encoder = {"edge_scale": cfg.encoder.edge_scale_m, "position_scale": cfg.encoder.position_scale_m}
        self._network = published.PublishedDelo(relative=cfg.encoder.edges == "relative", **encoder)
        published.load(self._network, model.variables)
        self._network.float().eval()
        self._mass, self._num_iters = cfg.matching.mass, cfg.matching.num_iters
        torch.set_num_threads(NUM_THREADS)

    def features(self, points: Any) -> Any:
        """phi (n, d) of points (n, 3): the twin's layers, neighbours by the fastest exact distances that PyTorch has."""
        import torch

        encoder = self._network.encoder
        distances = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
        neighbors = points[distances.topk(self._num_neighbors, dim=1, largest=False).indices]
        centers = points[:, None].expand_as(neighbors)
        first = (neighbors - centers) / encoder.edge_scale if encoder.relative else neighbors / encoder.position_scale
        edges = torch.cat([first, centers / encoder.position_scale], dim=2).permute(2, 0, 1)[None]
        maxima = []
        for convolution, norm in zip(encoder.convolutions, encoder.norms, strict=True):
            edges = torch.relu(norm(convolution(edges)))
            maxima.append(edges.amax(dim=3, keepdim=True))
        return torch.relu(encoder.last_norm(encoder.last_convolution(torch.cat(maxima, dim=1))))[0, :, :, 0].T

    def __call__(self, source: Any, target: Any, head: str) -> np.ndarray:
        """T_target_source of two clouds, tensors (n, 3) [m]; the head is `softmax`, `dense` or `scaled`."""
        import torch

        with torch.inference_mode():
            phi = self.features(source), self.features(target)
            ours, theirs = (own + self._network.context(own, other) for own, other in (phi, phi[::-1]))
            scores = ours @ theirs.T / ours.shape[1] ** 0.5
            if head == "softmax":
                plan = torch.softmax(scores, dim=1) / len(scores)
            elif head == "dense":
                plan = dense_transport(-torch.log_softmax(scores, dim=1), mass=self._mass, num_iters=self._num_iters)
            else:
                plan = self._clipped(-torch.log_softmax(scores, dim=1), 1.0, self._mass, self._num_iters)
            return self._procrustes(source, target, plan, 0.0).numpy()


class PaperSize(NamedTuple):
    """What was measured at paper size."""

    timings: dict[str, Timing]  # without PyTorch's where there is none
    apart_m: float  # largest difference of a translation between the two softmax networks; NaN where there is one alone
    apart_rad: float  # and of an entry of a rotation matrix


Call = Callable[[int], np.ndarray]  # the number of the turn in, a pose on the host out


def ours_at_paper_size(transport: delo.Model, softmax: delo.Model, scans: Sequence[ScanPair]) -> dict[str, Call]:
    """Both heads with nothing kept, and the streaming use of one."""
    kept, start = with_older_encoded(transport, scans), jnp.eye(4)

    def solved(model: delo.Model, source: delo.Encoding, target: delo.Encoding) -> np.ndarray:
        return np.asarray(inference.solve(model, source, target, start).T_target_source)

    def whole(model: delo.Model) -> Call:
        return lambda turn: solved(model, *(inference.encode(model, scan) for scan in scans[turn % len(scans)]))

    def streaming(turn: int) -> np.ndarray:
        source, target = kept[turn % len(kept)]
        return solved(transport, source, inference.encode(transport, target))

    return {SOFTMAX: whole(softmax), TRANSPORT: whole(transport), STREAMING: streaming}


def twin_at_paper_size(transport: delo.Model, scans: Sequence[ScanPair]) -> dict[str, Call]:
    """PyTorch with each head."""
    import torch

    twin = Twin(transport)
    tensors = [(torch.from_numpy(np.array(older.points)), torch.from_numpy(np.array(newer.points))) for older, newer in scans]

    def call(head: str) -> Call:
        return lambda turn: twin(*tensors[turn % len(tensors)], head)

    return {TORCH_SOFTMAX: call("softmax"), TORCH_DENSE: call("dense"), TORCH_SCALED: call("scaled")}


def time_paper(sweeps: Sequence[tuple[Sweep, Sweep]], num: int, warm_up: int) -> PaperSize:
    """The paper's network at N = 1024, D = 512, in JAX and in PyTorch, from points to the pose on the host."""
    transport, softmax = paper_models()
    scans = prepared(sweeps, transport.cfg)
    calls = ours_at_paper_size(transport, softmax, scans)
    if torch_missing():
        return PaperSize(in_turns(calls, num, warm_up=warm_up), np.nan, np.nan)
    theirs = twin_at_paper_size(transport, scans)
    timings = in_turns(calls | theirs, num, warm_up=warm_up)
    apart = np.abs([calls[SOFTMAX](turn) - theirs[TORCH_SOFTMAX](turn) for turn in range(len(scans))])
    return PaperSize(timings, float(apart[:, :3, 3].max()), float(apart[:, :3, :3].max()))
