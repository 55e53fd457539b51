"""Configuration: frozen dataclasses, TOML in and out, unknown keys refused. No jax import."""

import dataclasses
import difflib
import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from delo_jax.errors import ConfigError

T = TypeVar("T")

LEVER_M = 15.0  # a rotation moves the scene by about this arm; makes rotations and translations comparable
NUM_FEATURES = 8  # numbers per point that `preprocess` computes and the network reads


def require(condition: bool, name: str, expected: str, got: object) -> None:
    """Raise a ConfigError `name: expected ..., got ...` unless the condition holds."""
    if not condition:
        raise ConfigError(f"{name}: expected {expected}, got {got!r}")


def require_positive(config: object, where: str, *names: str) -> None:
    """Raise a ConfigError unless all of these fields are above zero."""
    for name in names:
        require(getattr(config, name) > 0, f"{where}{name}", "a value above 0", getattr(config, name))


@dataclasses.dataclass(frozen=True, kw_only=True)
class PreprocessConfig:
    """Raw points to a padded `Scan`."""

    min_range_m: float = 2.7
    """Points nearer than this are the vehicle itself."""
    max_range_m: float = 75.0
    """Points farther than this are dropped."""
    voxel_m: float = 0.2
    """Voxel size of the cloud in which neighbours are sought."""
    point_voxel_m: float = 0.7
    """One point is kept per voxel of this size."""
    num_neighbors: int = 16
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
        require(0.0 <= self.min_range_m < self.max_range_m, "preprocess.min_range_m", "0 <= min_range_m < max_range_m", self.min_range_m)
        require_positive(self, "preprocess.", "keypoint_voxel_m", "keypoint_range_m")
        require(0.0 < self.voxel_m <= self.point_voxel_m, "preprocess.voxel_m", "0 < voxel_m <= point_voxel_m", self.voxel_m)
        require(self.num_neighbors >= 5, "preprocess.num_neighbors", "at least 5", self.num_neighbors)
        require(0.0 < self.ground_share <= 1.0, "preprocess.ground_share", "a value in (0, 1]", self.ground_share)
        require(0 < self.num_keypoints <= self.max_points, "preprocess.num_keypoints", "1 to max_points", self.num_keypoints)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CoarseConfig:
    """Matching of key points and the consistency-weighted pose."""

    num_neighbors: int = 12
    """Neighbours of a key point in the static graph of the edge convolutions."""
    edge_scale_m: float = 4.0
    """Relative edges are divided by this length."""
    width: int = 64
    """Channels of the edge convolutions."""
    embedding_dim: int = 64
    """D: length of a descriptor."""
    mass: float = 0.6
    """Transported fraction of the total mass, in (0, 1]."""
    num_iters: int = 10
    """Projection rounds of the transport; static, it fixes the length of the loop."""
    consistency_m: float = 0.8
    """Two matches whose lengths differ by this are incompatible."""
    num_rounds: int = 3
    """Reweighted rounds of the planar pose."""

    def __post_init__(self):
        require_positive(self, "coarse.", "num_neighbors", "edge_scale_m", "width", "embedding_dim", "consistency_m")
        require(0.0 < self.mass <= 1.0, "coarse.mass", "a value in (0, 1]", self.mass)
        require(self.num_iters >= 1, "coarse.num_iters", "at least 1", self.num_iters)


@dataclasses.dataclass(frozen=True, kw_only=True)
class FineConfig:
    """Learned weighted point-to-plane registration."""

    num_points: int = 1024
    """N: source points solved for."""
    num_iters: int = 8
    """Gauss-Newton iterations at inference."""
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
        require(self.num_iters >= 2, "fine.num_iters", "at least 2: one per hypothesis, one after the choice", self.num_iters)


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvidenceConfig:
    """Normal-inverse-gamma head on the statistics of the solver."""

    width: int = 32
    """Hidden channels."""
    rotation_scale_rad: float = 1e-3
    """Unit of the head's rotation outputs."""
    translation_scale_m: float = 1e-2
    """Unit of the head's translation outputs."""

    def __post_init__(self):
        require_positive(self, "evidence.", "width", "rotation_scale_rad", "translation_scale_m")


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
    coarse: CoarseConfig = CoarseConfig()
    """Coarse stage."""
    fine: FineConfig = FineConfig()
    """Fine stage."""
    evidence: EvidenceConfig = EvidenceConfig()
    """Evidence head."""
    status: StatusConfig = StatusConfig()
    """Health status."""

    def __post_init__(self):
        fits = 0 < self.coarse.num_neighbors <= self.preprocess.num_keypoints
        require(fits, "coarse.num_neighbors", "1 to preprocess.num_keypoints", self.coarse.num_neighbors)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """One training run on simulated worlds."""

    model: DeloConfig = DeloConfig()
    """Network to train."""
    seed: int = 0
    """Seed of worlds, initial weights and batches."""
    num_scenes: int = 560
    """Simulated training scenes; scene kinds take turns."""
    num_validation_scenes: int = 40
    """Scenes of unseen seeds for validation."""
    num_frames: int = 6
    """Scans per scene, so gaps 1 to num_frames - 1."""
    num_steps: int = 3000
    """Optimiser steps of matching and pose."""
    num_evidence_steps: int = 1200
    """Optimiser steps of the evidence head, on the finished solver."""
    batch_size: int = 8
    """Pairs per step."""
    num_points: int = 512
    """Source points of the fine stage in training."""
    num_iters: int = 4
    """Fine iterations in training, pose detached between them."""
    learning_rate: float = 2e-3
    """Peak of the cosine schedule."""
    warmup_steps: int = 100
    """Linear warm-up."""
    coarse_weight: float = 0.1
    """Weight of the matching loss; 0 switches it off."""
    fine_weight: float = 1.0
    """Weight of the pose loss; 0 switches it off."""
    evidence_weight: float = 1.0
    """Weight of the evidence loss, learned after the other two; 0 switches it off."""
    regulariser_weight: float = 0.01
    """lambda_R of the evidence loss."""
    validate_every: int = 250
    """Steps between validations and checkpoints."""

    def __post_init__(self):
        require(self.num_frames >= 2, "num_frames", "at least 2", self.num_frames)
        require_positive(self, "", "num_scenes", "num_validation_scenes", "batch_size", "num_points", "learning_rate", "validate_every")
        require(self.seed >= 0, "seed", "at least 0", self.seed)
        for name in ("num_steps", "num_evidence_steps"):
            require(getattr(self, name) == 0 or getattr(self, name) >= 10, name, "0 or at least 10", getattr(self, name))
        for name in ("coarse_weight", "fine_weight", "evidence_weight", "regulariser_weight"):
            require(getattr(self, name) >= 0, name, "at least 0", getattr(self, name))
        require(1 <= self.num_iters <= 4, "num_iters", "1 to 4, as many as the loss has weights", self.num_iters)


def from_dict(cls: type[T], table: Mapping[str, Any], where: str = "config") -> T:
    """Config from nested tables; keys not given keep their defaults, unknown keys are an error.

    Raises:
        ConfigError: an unknown key (with the nearest known one) or a value of the wrong type or range.
    """
    fields = {field.name: field for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key not in fields:
            near = difflib.get_close_matches(key, fields, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise ConfigError(f"{where}: expected one of {', '.join(fields)}, got {key!r}{hint}")
        values[key] = _value(fields[key].default, value, f"{where}.{key}")
    return cls(**values)


def _value(default: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(default):
        require(isinstance(value, Mapping), where, "a table", value)
        return from_dict(type(default), value, where)
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    require(type(value) is type(default), where, f"a value of type {type(default).__name__}", value)
    return value


def load(cls: type[T], path: Path) -> T:
    """Config from a TOML file.

    Raises:
        ConfigError: unreadable file, TOML syntax, unknown key, wrong type or range.
    """
    try:
        table = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: expected a readable TOML file, got {error.strerror}; check the path") from error
    except ValueError as error:
        raise ConfigError(f"{path}: expected valid TOML, got {error}; mend the file") from error
    return from_dict(cls, table, str(path))


def to_toml(config: Any) -> str:
    """The config as TOML that `load` reads back to an equal one."""
    return "\n".join(_lines(config, "")).strip() + "\n"


def _lines(config: Any, prefix: str) -> list[str]:
    values = {field.name: getattr(config, field.name) for field in dataclasses.fields(config) if field.metadata.get("toml", True)}
    values = {key: value for key, value in values.items() if value is not None}  # TOML has no null: the key is left out
    lines = [f"{key} = {_toml_value(value)}" for key, value in values.items() if not dataclasses.is_dataclass(value)]
    for key, value in values.items():
        if dataclasses.is_dataclass(value):
            lines += ["", f"[{prefix}{key}]", *_lines(value, f"{prefix}{key}.")]
    return lines


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str | Path):
        return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")  # the escapes of JSON are TOML's, which has one more
    return repr(value)
