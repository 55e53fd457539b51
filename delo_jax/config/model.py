"""Config of a network: everything that belongs to a set of weights."""

import dataclasses

from delo_jax.config.checks import require, require_one_of, require_positive

LEVER_M = 15.0  # a rotation moves the scene by about this arm; makes rotations and translations comparable
NUM_FEATURES = 8  # numbers per point that `preprocess` computes and the network reads
MIN_EPSILON = 0.01  # floor of a learned entropic weight; below it a plan in float32 loses its digits
SAMPLINGS = ("surface", "raw")
PLANS = (
    "softmax",
    "dual_softmax",
    "softmax_confidence",
    "algorithm_1",
    "released_code",
    "partial_transport",
    "sparse_transport",
    "dustbin_transport",
    "unbalanced_transport",
)
SOLVERS = ("procrustes", "argmax", "consistency")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PreprocessConfig:
    """Raw points to a padded `Scan`."""

    sampling: str = "surface"
    """`surface`: a point per voxel on its fitted plane, with normal and features; `raw`: evenly spaced points, all of them key points."""
    min_range_m: float = 2.7
    """Points nearer than this are the vehicle itself."""
    max_range_m: float = 75.0
    """Points farther than this are dropped."""
    max_raw_points: int = 65_536
    """Of a scan of more points, one at random of every two, three, ... that follow each other is used."""
    voxel_m: float = 0.3
    """Voxel size of the cloud in which neighbours are sought."""
    point_voxel_m: float = 0.9
    """One point is kept per voxel of this size."""
    num_neighbors: int = 8
    """Neighbours of the plane fit."""
    max_points: int = 3072
    """M: points kept, and the padded length of every scan."""
    ground_share: float = 0.4
    """Largest share of M that near-horizontal surfaces may take."""
    num_keypoints: int = 384
    """K: key points of the coarse stage, and their padded length."""
    keypoint_voxel_m: float = 1.2
    """One key point per voxel of this size."""
    keypoint_range_m: float = 55.0
    """Key points lie nearer than this."""

    def __post_init__(self):
        require_one_of(self.sampling, "preprocess.sampling", SAMPLINGS)
        require(0.0 <= self.min_range_m < self.max_range_m, "preprocess.min_range_m", "0 <= min_range_m < max_range_m", self.min_range_m)
        require_positive(self, "preprocess.", "max_raw_points", "keypoint_voxel_m", "keypoint_range_m")
        require(0.0 < self.voxel_m <= self.point_voxel_m, "preprocess.voxel_m", "0 < voxel_m <= point_voxel_m", self.voxel_m)
        require(self.num_neighbors >= 5, "preprocess.num_neighbors", "at least 5", self.num_neighbors)
        require(0.0 < self.ground_share <= 1.0, "preprocess.ground_share", "a value in (0, 1]", self.ground_share)
        require(0 < self.num_keypoints <= self.max_points, "preprocess.num_keypoints", "1 to max_points", self.num_keypoints)
        all_are = self.sampling != "raw" or self.num_keypoints == self.max_points
        require(all_are, "preprocess.num_keypoints", "max_points, with raw sampling", self.num_keypoints)


@dataclasses.dataclass(frozen=True, kw_only=True)
class EncoderConfig:
    """Descriptors of key points from their neighbourhood."""

    kind: str = "edge_conv"
    """`edge_conv`: three edge convolutions on points, normals and features; `dgcnn`: the paper's, on points alone."""
    num_neighbors: int = 12
    """Neighbours of a key point in the static graph."""
    edges: str = "relative"
    """What `dgcnn` sees of a neighbour: `relative` to its centre, or `absolute` as in the released code."""
    edge_scale_m: float = 4.0
    """Relative edges are divided by this length."""
    position_scale_m: float = 1.0
    """Positions, where `dgcnn` sees them, are divided by this length."""
    width: int = 64
    """Channels of the first convolutions."""
    embedding_dim: int = 64
    """D: length of a descriptor."""

    def __post_init__(self):
        require_one_of(self.kind, "encoder.kind", ("edge_conv", "dgcnn"))
        require_one_of(self.edges, "encoder.edges", ("relative", "absolute"))
        require_positive(self, "encoder.", "num_neighbors", "edge_scale_m", "position_scale_m", "width", "embedding_dim")
        fits = self.edges == "relative" or self.kind == "dgcnn"
        require(fits, "encoder.edges", "relative, the only ones of edge_conv", self.edges)


@dataclasses.dataclass(frozen=True, kw_only=True)
class AttentionConfig:
    """Co-contextual transformer between the descriptors of both scans."""

    num_heads: int = 0
    """Attention heads; 0 leaves the transformer out."""
    hidden: int = 1024
    """Hidden channels of its feed-forward layers."""

    def __post_init__(self):
        require(self.num_heads >= 0, "attention.num_heads", "at least 0", self.num_heads)
        require_positive(self, "attention.", "hidden")


@dataclasses.dataclass(frozen=True, kw_only=True)
class MatchingConfig:
    """From descriptors to a plan: how much of each source point goes to which target point."""

    plan: str = "partial_transport"
    """One of `PLANS`."""
    scores: str = "cosine"
    """`cosine`: cosines times a learned factor; `scaled`: inner products over sqrt(D), as in the paper."""
    mass: float = 0.6
    """Transported fraction of the total mass, in (0, 1]."""
    predict_mass: bool = False
    """Mass of each pair from how well its descriptors fit, in place of `mass`."""
    epsilon: float = 1.0
    """Entropic weight, or its start where it is learned."""
    learn_epsilon: bool = False
    """Learn the entropic weight."""
    num_iters: int = 10
    """Projection rounds of the transport; static, it fixes the length of the loop."""
    num_candidates: int = 16
    """Targets that a source point may go to, in `sparse_transport`."""
    marginal_weight: float = 1.0
    """Weight of the marginals of `unbalanced_transport`."""

    def __post_init__(self):
        require_one_of(self.plan, "matching.plan", PLANS)
        require_one_of(self.scores, "matching.scores", ("cosine", "scaled"))
        require(0.0 < self.mass <= 1.0, "matching.mass", "a value in (0, 1]", self.mass)
        require(self.num_iters >= 1, "matching.num_iters", "at least 1", self.num_iters)
        require_positive(self, "matching.", "epsilon", "num_candidates", "marginal_weight")
        with_mass = "partial_transport", "sparse_transport", "algorithm_1", "released_code"
        fits = not self.predict_mass or self.plan in with_mass
        require(fits, "matching.predict_mass", f"false, since {self.plan} takes no mass", self.predict_mass)
        above = not self.learn_epsilon or self.epsilon > MIN_EPSILON
        require(above, "matching.epsilon", f"a start above {MIN_EPSILON:g} where it is learned", self.epsilon)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PoseConfig:
    """From a plan to a pose."""

    solver: str = "consistency"
    """`procrustes` on the plan, as in the paper; `argmax`: on the best match of each row; `consistency`: on best matches that agree."""
    consistency_m: float = 0.8
    """Two matches whose lengths differ by this are incompatible."""
    num_rounds: int = 3
    """Reweighted rounds of the planar pose."""

    def __post_init__(self):
        require_one_of(self.solver, "pose.solver", SOLVERS)
        require_positive(self, "pose.", "consistency_m", "num_rounds")


@dataclasses.dataclass(frozen=True, kw_only=True)
class FineConfig:
    """Learned weighted point-to-plane registration."""

    num_points: int = 1024
    """N: source points solved for."""
    num_iters: int = 8
    """Gauss-Newton iterations at inference; 0 leaves the fine stage out."""
    point_width: int = 32
    """Hidden channels of the point embedding."""
    point_dim: int = 16
    """Length of a point embedding."""
    edge_width: int = 32
    """Hidden channels of the edge network."""
    damping: float = 1e-4
    """Relative damping of the 6 x 6 system."""

    def __post_init__(self):
        require(self.num_points >= 16, "fine.num_points", "at least 16", self.num_points)
        enough = self.num_iters == 0 or self.num_iters >= 2
        require(enough, "fine.num_iters", "0, or at least 2: one per hypothesis, one after the choice", self.num_iters)


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvidenceConfig:
    """Normal-inverse-gamma head."""

    head: str = "statistics"
    """`statistics` of the solver; `embedding`: pooled descriptors and the pose, as in the paper; `none`."""
    embedding: str = "context"
    """What the `embedding` head pools: descriptors after the transformer (`context`) or before it (`encoder`)."""
    width: int = 32
    """Hidden channels of the `statistics` head."""
    rotation_scale_rad: float = 1e-3
    """Unit of the `statistics` head's rotation outputs."""
    translation_scale_m: float = 1e-2
    """Unit of the `statistics` head's translation outputs."""
    covariance_width: int = 0
    """Hidden channels of the covariance that `delo calibrate` fits on top of it; 0: there is none yet, the evidence stands as it is."""

    def __post_init__(self):
        require_one_of(self.head, "evidence.head", ("statistics", "embedding", "none"))
        require_one_of(self.embedding, "evidence.embedding", ("context", "encoder"))
        require_positive(self, "evidence.", "width", "rotation_scale_rad", "translation_scale_m")
        fits = self.covariance_width == 0 or (self.covariance_width > 0 and self.head == "statistics")
        require(fits, "evidence.covariance_width", "0, or more with the statistics head", self.covariance_width)


@dataclasses.dataclass(frozen=True, kw_only=True)
class StatusConfig:
    """From numbers to a status."""

    lost_translation_m: float = 0.5
    """A pair off by more than this is lost."""
    lost_rotation_deg: float = 2.0
    """A pair off by more than this is lost."""
    ok_confidence: float = 0.8
    """Below this confidence a pair is `low_confidence`."""
    rejected_confidence: float = 0.2
    """Below this confidence a pair is `rejected`."""
    min_points: int = 100
    """A scan with fewer usable points is `rejected`."""
    min_observability: float = 3e-3
    """Mean squared plane distance that a metre of motion must cause in every direction [m^2/m^2], else `degenerate`."""
    unknown_rotation_deg: float = 30.0
    """Standard deviation of a pose nobody measured."""
    unknown_translation_m: float = 5.0
    """Standard deviation of a pose nobody measured."""

    def __post_init__(self):
        limits = 0.0 <= self.rejected_confidence <= self.ok_confidence <= 1.0
        require(limits, "status.ok_confidence", "0 <= rejected_confidence <= ok_confidence <= 1", self.ok_confidence)


@dataclasses.dataclass(frozen=True, kw_only=True)
class DeloConfig:
    """Everything that belongs to a set of weights."""

    name: str = "base"
    """Preset the weights were trained from."""
    preprocess: PreprocessConfig = PreprocessConfig()
    """Raw points to scans."""
    encoder: EncoderConfig = EncoderConfig()
    """Descriptors of key points."""
    attention: AttentionConfig = AttentionConfig()
    """Transformer between both scans."""
    matching: MatchingConfig = MatchingConfig()
    """Plan between key points."""
    pose: PoseConfig = PoseConfig()
    """Pose from the plan."""
    fine: FineConfig = FineConfig()
    """Fine stage."""
    evidence: EvidenceConfig = EvidenceConfig()
    """Evidence head."""
    status: StatusConfig = StatusConfig()
    """Health status."""

    def __post_init__(self):
        fits = 0 < self.encoder.num_neighbors <= self.preprocess.num_keypoints
        require(fits, "encoder.num_neighbors", "1 to preprocess.num_keypoints", self.encoder.num_neighbors)
        heads = self.attention.num_heads
        require(not heads or self.encoder.embedding_dim % heads == 0, "attention.num_heads", "a divisor of encoder.embedding_dim", heads)
        unit = self.encoder.kind == "edge_conv" and heads == 0
        require(unit or self.matching.scores == "scaled", "matching.scores", "scaled, since descriptors are not unit", self.matching.scores)
        surface = self.preprocess.sampling == "surface"
        require(surface or self.encoder.kind == "dgcnn", "encoder.kind", "dgcnn, since raw scans have no features", self.encoder.kind)
        require(surface or self.fine.num_iters == 0, "fine.num_iters", "0, since raw scans have no normals", self.fine.num_iters)
        has_fine = self.fine.num_iters > 0
        fits = self.evidence.head != "statistics" or has_fine
        require(fits, "evidence.head", "embedding or none, since statistics are those of the fine stage", self.evidence.head)
