"""The published network in PyTorch, in inference mode: written from a description of the released code, apart from ours.

One pair of clouds without padding, in float64. Import it only after `pytest.importorskip("torch")`. Linear algebra is
torch's, neighbours are found here, in float64. `load_*` copy our variables into it; names and layouts are the only
thing that the two have in common.
"""

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import nn

NUM_NEIGHBORS = 20  # the point itself included
NUM_ROUNDS = 5  # of the transport
NUM_POINTS = 1024


class Dgcnn(nn.Module):
    """DCP's DGCNN: static graph, edge = (neighbour xyz, centre xyz), 1x1 convolutions per edge.

    With `relative` an edge is (neighbour - centre, centre), as in the DGCNN paper. Lengths are divided by their scale [m].
    """

    def __init__(self, width=64, embedding_dim=512, relative=False, edge_scale=1.0, position_scale=1.0):
        super().__init__()
        self.relative, self.edge_scale, self.position_scale = relative, edge_scale, position_scale
        widths = [6, width, width, 2 * width, 4 * width]
        self.convolutions = nn.ModuleList(nn.Conv2d(a, b, kernel_size=1, bias=False) for a, b in zip(widths[:-1], widths[1:], strict=True))
        self.norms = nn.ModuleList(nn.BatchNorm2d(b) for b in widths[1:])
        self.last_convolution = nn.Conv2d(sum(widths[1:]), embedding_dim, kernel_size=1, bias=False)
        self.last_norm = nn.BatchNorm2d(embedding_dim)

    def forward(self, xyz):
        """Features (n, d) of points (n, 3) [m]."""
        distances = torch.linalg.vector_norm(xyz[:, None] - xyz[None, :], dim=2)
        neighbors = xyz[distances.topk(NUM_NEIGHBORS, dim=1, largest=False).indices]
        centers = xyz[:, None].expand_as(neighbors)
        first = (neighbors - centers) / self.edge_scale if self.relative else neighbors / self.position_scale
        edges = torch.cat([first, centers / self.position_scale], dim=2).permute(2, 0, 1)[None]  # (1, 6, n, k)
        maxima = []
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            edges = torch.relu(norm(convolution(edges)))
            maxima.append(edges.amax(dim=3, keepdim=True))
        return torch.relu(self.last_norm(self.last_convolution(torch.cat(maxima, dim=1))))[0, :, :, 0].T


class AnnotatedLayerNorm(nn.Module):
    """Unbiased standard deviation, epsilon added to it."""

    def __init__(self, width):
        super().__init__()
        self.weight, self.bias = nn.Parameter(torch.ones(width)), nn.Parameter(torch.zeros(width))

    def forward(self, x):
        """Normalised rows."""
        return self.weight * (x - x.mean(-1, keepdim=True)) / (x.std(-1, keepdim=True) + 1e-6) + self.bias


def feed_forward(width, hidden):
    """Linear, ReLU, linear."""
    return nn.Sequential(nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, width))


class Pointer(nn.Module):
    """DCP's transformer: one encoder block, one decoder block, pre-norm, a final norm after each; torch's own attention."""

    def __init__(self, width=512, num_heads=4, hidden=1024):
        super().__init__()
        self.encoder_attention, self.decoder_attention, self.cross_attention = (
            nn.MultiheadAttention(width, num_heads, batch_first=True) for _ in range(3)
        )
        self.encoder_feed_forward, self.decoder_feed_forward = feed_forward(width, hidden), feed_forward(width, hidden)
        self.encoder_norms = nn.ModuleList(AnnotatedLayerNorm(width) for _ in range(3))
        self.decoder_norms = nn.ModuleList(AnnotatedLayerNorm(width) for _ in range(4))

    def forward(self, y, x):
        """pointer(y, x) of rows (n, d): the decoder reads y, the encoder reads x."""
        x = x + attend(self.encoder_attention, self.encoder_norms[0](x))
        x = x + self.encoder_feed_forward(self.encoder_norms[1](x))
        memory = self.encoder_norms[2](x)
        y = y + attend(self.decoder_attention, self.decoder_norms[0](y))
        y = y + attend(self.cross_attention, self.decoder_norms[1](y), memory)
        y = y + self.decoder_feed_forward(self.decoder_norms[2](y))
        return self.decoder_norms[3](y)


def attend(attention, query, memory=None):
    """torch's attention for rows without a batch."""
    memory = query if memory is None else memory
    return attention(query[None], memory[None], memory[None], need_weights=False)[0][0]


class EvidenceNetwork(nn.Module):
    """PU-EPE: max-pooled embeddings and the pose to 24 raw numbers."""

    def __init__(self, embedding_dim=512):
        super().__init__()

        def layers(*widths):
            pairs = zip(widths[:-1], widths[1:], strict=True)
            return [layer for a, b in pairs for layer in (nn.Linear(a, b), nn.BatchNorm1d(b), nn.ReLU())]

        self.pair = nn.Sequential(*layers(2 * embedding_dim, 256, 128, 64), nn.Linear(64, 64))
        self.fusion = nn.Sequential(*layers(70, 128, 64), nn.Linear(64, 48))
        self.nig = nn.Linear(48, 24)

    def forward(self, source, target, pose6):
        """Raw numbers (24,) from embeddings (n, d) and the pose: Euler angles and translation."""
        pooled = torch.cat([source.amax(dim=0), target.amax(dim=0)])[None]
        return self.nig(self.fusion(torch.cat([self.pair(pooled), pose6[None]], dim=1)))[0]


class Answer(NamedTuple):
    """Every intermediate result of a pair, NumPy float64; rows source, columns target."""

    source_features: np.ndarray  # phi (n, d)
    target_features: np.ndarray
    source_embeddings: np.ndarray  # Phi (n, d), after the transformer
    target_embeddings: np.ndarray
    scores: np.ndarray  # (n, m), divided by sqrt(d)
    plan: np.ndarray  # (n, m)
    T_target_source: np.ndarray  # (4, 4)
    pose6: np.ndarray  # (6,) intrinsic XYZ Euler angles, translation
    raw: np.ndarray  # (24,) gamma, nu, alpha, beta of six


class PublishedDelo(nn.Module):
    """DELO with PU-EPE.

    Args of the call: `head` is "transport" (the code's loop), "dykstra" (the cited algorithm) or "pointer" (DCP's softmax);
    `mass` 1.0 in the code, 0.1 in print; `slack` 1e-6 in the code, 0 for exact divisions. What the edges are, see `Dgcnn`.
    """

    def __init__(self, **edges):
        super().__init__()
        self.encoder, self.context, self.evidence = Dgcnn(**edges), Pointer(), EvidenceNetwork()
        self.double().eval()

    @torch.no_grad()
    def forward(self, source, target, *, head="transport", epsilon=1.0, mass=1.0, num_iters=NUM_ROUNDS, slack=0.0):
        """Answer for source and target points (n, 3) in metres."""
        source, target = (torch.as_tensor(np.asarray(points, np.float64)) for points in (source, target))
        phi_source, phi_target = self.encoder(source), self.encoder(target)
        embedding_source = phi_source + self.context(phi_source, phi_target)
        embedding_target = phi_target + self.context(phi_target, phi_source)
        scores = embedding_source @ embedding_target.T / embedding_source.shape[1] ** 0.5
        cost = -torch.log_softmax(scores, dim=1)
        match head:
            case "transport":
                plan = clipped_transport(cost, epsilon, mass, num_iters)
            case "dykstra":
                plan = dykstra_transport(cost, epsilon, mass, num_iters)
            case "pointer":
                plan = torch.softmax(scores, dim=1) / len(scores)
        T = procrustes(source, target, plan, slack)
        pose6 = torch.cat([torch.as_tensor(Rotation.from_matrix(T[:3, :3].numpy()).as_euler("XYZ")), T[:3, 3]])
        raw = self.evidence(embedding_source, embedding_target, pose6)
        results = (phi_source, phi_target, embedding_source, embedding_target, scores, plan, T, pose6, raw)
        return Answer(*(result.numpy() for result in results))


def clipped_transport(cost, epsilon, mass, num_iters):
    """The code's loop: linear domain, scaled first, rows, columns and mass clipped in place, no corrections."""
    n, m = cost.shape
    plan = torch.exp(-cost / epsilon)
    plan = plan * mass / plan.sum()
    for _ in range(num_iters):
        plan = plan * torch.clamp((1 / n) / plan.sum(dim=1, keepdim=True), max=1.0)
        plan = plan * torch.clamp((1 / m) / plan.sum(dim=0, keepdim=True), max=1.0)
        plan = plan * mass / plan.sum()
    return plan


def dykstra_transport(cost, epsilon, mass, num_iters):
    """Partial transport by Dykstra's projections (Benamou et al. 2015), full matrices in the linear domain."""
    n, m = cost.shape
    plan = torch.exp(-cost / epsilon)
    plan = plan * mass / plan.sum()
    projections = (
        lambda plan: plan * torch.clamp((1 / n) / plan.sum(dim=1, keepdim=True), max=1.0),
        lambda plan: plan * torch.clamp((1 / m) / plan.sum(dim=0, keepdim=True), max=1.0),
        lambda plan: plan * mass / plan.sum(),
    )
    corrections = [torch.ones_like(plan)] * 3
    for _ in range(num_iters):
        for i, project in enumerate(projections):
            corrected = plan * corrections[i]
            plan = project(corrected)
            corrections[i] = corrected / plan
    return plan


def procrustes(source, target, plan, slack):
    """T_target_source of the virtual targets plan @ target / row sums, weighted by the row sums, by torch's SVD."""
    row_sums = plan.sum(dim=1, keepdim=True)
    virtual = plan @ target / (row_sums + slack)
    weights = row_sums / (row_sums.sum() + slack)
    source_mean, virtual_mean = (weights * source).sum(dim=0), (weights * virtual).sum(dim=0)
    U, _, Vt = torch.linalg.svd((source - source_mean).T @ (weights * (virtual - virtual_mean)))
    V = Vt.T
    R = V @ U.T
    if torch.linalg.det(R) < 0:
        R = torch.cat([V[:, :2], -V[:, 2:]], dim=1) @ U.T
    T = torch.eye(4, dtype=source.dtype)
    T[:3, :3], T[:3, 3] = R, virtual_mean - R @ source_mean
    return T


def num_weights(module):
    """Number of trained weights."""
    return sum(parameter.numel() for parameter in module.parameters())


def load(network: PublishedDelo, variables) -> None:
    """The variables of our whole network: its blocks `encoder`, `co_context` and, where there is one, `evidence_head`."""
    for name, module, load_block in (
        ("encoder", network.encoder, load_dgcnn),
        ("co_context", network.context, load_pointer),
        ("evidence_head", network.evidence, load_evidence),
    ):
        if name in variables["params"]:
            load_block(module, {collection: blocks[name] for collection, blocks in variables.items() if name in blocks})


def load_dgcnn(module: Dgcnn, variables) -> None:
    """Our DGCNN's variables, running statistics included."""
    params, stats = variables["params"], variables["batch_stats"]
    for level, (convolution, norm) in enumerate(zip(module.convolutions, module.norms, strict=True)):
        _load_convolution(convolution, params[f"conv_{level}"])
        load_norm(norm, params[f"norm_{level}"], stats[f"norm_{level}"])
    _load_convolution(module.last_convolution, params["conv_out"])
    load_norm(module.last_norm, params["norm_out"], stats["norm_out"])


def load_pointer(module: Pointer, variables) -> None:
    """Our CoContext's variables."""
    encoder, decoder = variables["params"]["encoder"], variables["params"]["decoder"]
    load_attention(module.encoder_attention, encoder["attention"])
    load_attention(module.decoder_attention, decoder["self_attention"])
    load_attention(module.cross_attention, decoder["cross_attention"])
    for layers, ours in ((module.encoder_feed_forward, encoder["feed_forward"]), (module.decoder_feed_forward, decoder["feed_forward"])):
        _load_linear(layers[0], ours["hidden"])
        _load_linear(layers[2], ours["out"])
    norms = [encoder[name] for name in ("attention_norm", "feed_forward_norm", "norm")]
    norms += [decoder[name] for name in ("self_norm", "cross_norm", "feed_forward_norm", "norm")]
    for norm, ours in zip([*module.encoder_norms, *module.decoder_norms], norms, strict=True):
        _copy(norm.weight, ours["scale"])
        _copy(norm.bias, ours["bias"])


def load_evidence(module: EvidenceNetwork, variables) -> None:
    """Our PoseEvidenceHead's variables, running statistics included."""
    params, stats = variables["params"], variables["batch_stats"]
    for name, layers, num_levels in (("pair", module.pair, 3), ("fusion", module.fusion, 2)):
        for level in range(num_levels):
            _load_linear(layers[3 * level], params[f"{name}_{level}"])
            load_norm(layers[3 * level + 1], params[f"{name}_norm_{level}"], stats[f"{name}_norm_{level}"])
        _load_linear(layers[-1], params[f"{name}_out"])
    _load_linear(module.nig, params["evidence"])


def load_norm(norm, params, stats) -> None:
    """Our BatchNorm's parameters and running statistics."""
    for tensor, array in ((norm.weight, params["scale"]), (norm.bias, params["bias"])):
        _copy(tensor, array)
    for tensor, array in ((norm.running_mean, stats["mean"]), (norm.running_var, stats["var"])):
        _copy(tensor, array)


def load_attention(attention, params) -> None:
    """Our MultiHeadAttention's parameters; torch stacks the three input projections."""
    inputs = [params[name] for name in ("query", "key", "value")]
    _copy(attention.in_proj_weight, np.concatenate([np.asarray(layer["kernel"]).T for layer in inputs]))
    _copy(attention.in_proj_bias, np.concatenate([np.asarray(layer["bias"]) for layer in inputs]))
    _load_linear(attention.out_proj, params["out"])


def _load_linear(linear, params) -> None:
    _copy(linear.weight, np.asarray(params["kernel"]).T)
    _copy(linear.bias, params["bias"])


def _load_convolution(convolution, params) -> None:
    _copy(convolution.weight, np.asarray(params["kernel"]).T[:, :, None, None])


@torch.no_grad()
def _copy(tensor, array) -> None:
    array = np.asarray(array)
    assert tensor.shape == array.shape, f"expected {tuple(tensor.shape)}, got {array.shape}"
    tensor.copy_(torch.as_tensor(np.array(array)))
