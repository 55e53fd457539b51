"""Configuration: frozen dataclasses, TOML in and out, unknown keys refused. No jax import."""

from delo_jax.config.checks import require, require_one_of, require_positive
from delo_jax.config.model import (
    LEVER_M,
    MIN_EPSILON,
    NUM_FEATURES,
    PLANS,
    SAMPLINGS,
    SOLVERS,
    AttentionConfig,
    DeloConfig,
    EncoderConfig,
    EvidenceConfig,
    FineConfig,
    MatchingConfig,
    PoseConfig,
    PreprocessConfig,
    StatusConfig,
)
from delo_jax.config.refining import GATES, RefineConfig
from delo_jax.config.toml import from_dict, load, to_toml
from delo_jax.config.training import TrainConfig

__all__ = [
    "AttentionConfig",
    "DeloConfig",
    "EncoderConfig",
    "EvidenceConfig",
    "FineConfig",
    "GATES",
    "LEVER_M",
    "MIN_EPSILON",
    "MatchingConfig",
    "NUM_FEATURES",
    "PLANS",
    "PoseConfig",
    "PreprocessConfig",
    "RefineConfig",
    "SAMPLINGS",
    "SOLVERS",
    "StatusConfig",
    "TrainConfig",
    "from_dict",
    "load",
    "require",
    "require_one_of",
    "require_positive",
    "to_toml",
]
