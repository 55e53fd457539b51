"""Named training runs, each with its network: the paper's, the released code's, DCP's, and ours."""

from dataclasses import replace

from delo_jax.config import (
    AttentionConfig,
    DeloConfig,
    EncoderConfig,
    EvidenceConfig,
    FineConfig,
    MatchingConfig,
    PoseConfig,
    PreprocessConfig,
    StatusConfig,
    TrainConfig,
)

_PAPER_MODEL = DeloConfig(
    name="paper",
    preprocess=PreprocessConfig(sampling="raw", min_range_m=0.0, max_range_m=1000.0, max_points=1024, num_keypoints=1024),
    encoder=EncoderConfig(
        kind="dgcnn", num_neighbors=20, edges="relative", edge_scale_m=1.0, position_scale_m=10.0, width=64, embedding_dim=512
    ),
    attention=AttentionConfig(num_heads=4, hidden=1024),
    matching=MatchingConfig(plan="partial_transport", scores="scaled", mass=0.1, num_iters=5, learn_epsilon=True),
    pose=PoseConfig(solver="procrustes"),
    fine=FineConfig(num_iters=0),
    evidence=EvidenceConfig(head="embedding"),
    status=StatusConfig(ok_confidence=0.2, rejected_confidence=0.0),  # theta_min; the paper takes every pose, however unsure
)
_PAPER = TrainConfig(
    model=_PAPER_MODEL,
    augment=False,
    num_epochs=75,
    num_steps=0,
    num_evidence_steps=0,
    batch_size=16,
    learning_rate=1e-4,
    schedule="constant",
    clip_norm=0.0,
    matching_weight=0.0,
    fine_weight=0.0,
    odometry_weight=1.0,
    aux_weight=0.05,
    evidence_weight=1.0,
    rotation_regulariser=0.2,
    translation_regulariser=0.2,
)
_OFFICIAL_MODEL = replace(
    _PAPER_MODEL,
    name="official",
    encoder=replace(_PAPER_MODEL.encoder, edges="absolute", position_scale_m=1.0),
    matching=replace(_PAPER_MODEL.matching, plan="released_code", mass=1.0),
)
_OFFICIAL = replace(
    _PAPER,
    model=_OFFICIAL_MODEL,
    num_epochs=200,
    learning_rate=1e-3,
    schedule="steps",
    pose_loss="matrix",
    aux_weight=0.05 / 3.0,  # the code's 0.05 is relative to a mean over coordinates
    evidence_weight=2e-4,  # the code's 1e-4 is relative to the sum of two means
    translation_regulariser=0.02,
)
_DCP = replace(
    _OFFICIAL,
    model=replace(
        _OFFICIAL_MODEL,
        name="dcp",
        matching=MatchingConfig(plan="softmax", scores="scaled"),
        evidence=EvidenceConfig(head="none"),
    ),
    evidence_weight=0.0,
)
_TINY = TrainConfig(
    model=DeloConfig(
        name="tiny",
        preprocess=PreprocessConfig(point_voxel_m=1.0, max_points=1024, num_keypoints=128, keypoint_voxel_m=1.8),
        encoder=EncoderConfig(num_neighbors=8, width=16, embedding_dim=32),
        fine=FineConfig(num_points=256, num_iters=6, point_width=16, point_dim=8, edge_width=16),
        evidence=EvidenceConfig(width=16),
    ),
    num_scenes=240,
    num_steps=1500,
    num_evidence_steps=800,
    num_points=256,
)

PRESETS = {"base": TrainConfig(), "tiny": _TINY, "paper": _PAPER, "official": _OFFICIAL, "dcp": _DCP}
