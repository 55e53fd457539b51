"""Config of a training run."""

import dataclasses

from delo_jax.config.checks import require, require_one_of, require_positive
from delo_jax.config.model import DeloConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """One training run, on simulated worlds or on recorded sequences."""

    model: DeloConfig = DeloConfig()
    """Network to train."""
    seed: int = 0
    """Seed of worlds, initial weights and batches."""
    recorded: str = ""
    """Names of the recorded sequences to train on, separated by blanks; empty: simulation."""
    num_scenes: int = 560
    """Simulated training scenes; scene kinds take turns."""
    num_validation_scenes: int = 40
    """Scenes of unseen seeds for validation."""
    num_frames: int = 6
    """Scans per simulated scene."""
    max_gap: int = 5
    """Frames between the two scans of a pair, at most."""
    augment: bool = True
    """Random yaw, mirror, dropped points and exchange of the two scans; without it a source is always the earlier scan."""
    num_epochs: int = 0
    """As many steps as so many passes over the training data take (pairs are drawn at random); 0: `num_steps`."""
    num_steps: int = 3000
    """Optimiser steps of matching and pose."""
    num_evidence_steps: int = 1200
    """Optimiser steps of the evidence head, on the finished solver; 0 with a weight above 0: learned together with the pose."""
    batch_size: int = 8
    """Pairs per step."""
    num_points: int = 512
    """Source points of the fine stage in training."""
    map_share: float = 0.6
    """Share of the augmented pairs whose fine stage learns against a local map of 2 to 5 frames rather than one scan."""
    num_map_points: int = 4096
    """Surfaces of such a map, the nearest ones, at most; no fewer than a scan has points."""
    num_iters: int = 4
    """Fine iterations in training, pose detached between them."""
    learning_rate: float = 2e-3
    """Of Adam; the peak of the schedule."""
    schedule: str = "cosine"
    """`cosine` after a linear warm-up; `constant`; `steps`: a tenth after epochs 15, 30 and 45, as in the released code."""
    warmup_steps: int = 100
    """Linear warm-up of the cosine schedule."""
    clip_norm: float = 1.0
    """Gradients are scaled down to this norm; 0 leaves them."""
    matching_weight: float = 0.1
    """Weight of the cross-entropy of scores against true matches; 0 switches it off."""
    matching_loss: str = "scores"
    """What that cross-entropy is of: the row and column softmax of the `scores`, or the whole `plan`."""
    fine_weight: float = 1.0
    """Weight of the fine stage's pose loss; 0 switches it off."""
    odometry_weight: float = 0.0
    """Weight of the paper's odometry loss, through plan and pose; 0 switches it off."""
    pose_loss: str = "l1"
    """Pose part of the odometry loss: `l1` of the moved points (paper) or `matrix` (released code)."""
    aux_weight: float = 0.05
    """lambda_aux of the odometry loss."""
    evidence_weight: float = 1.0
    """Weight of the evidence loss; 0 switches it off."""
    rotation_regulariser: float = 0.01
    """lambda_R of the evidence loss, rotations."""
    translation_regulariser: float = 0.01
    """lambda_R of the evidence loss, translations."""
    validate_every: int = 250
    """Steps between validations and checkpoints."""

    def __post_init__(self):
        require(self.num_frames >= 2, "num_frames", "at least 2", self.num_frames)
        positive = "num_scenes", "num_validation_scenes", "max_gap", "batch_size", "num_points", "learning_rate", "validate_every"
        require_positive(self, "", *positive)
        require_one_of(self.schedule, "schedule", ("cosine", "constant", "steps"))
        require(self.schedule != "steps" or self.num_epochs > 0, "num_epochs", "above 0 with schedule 'steps'", self.num_epochs)
        require_one_of(self.pose_loss, "pose_loss", ("l1", "matrix"))
        require_one_of(self.matching_loss, "matching_loss", ("scores", "plan"))
        for name in ("seed", "num_epochs", "clip_norm", "warmup_steps"):
            require(getattr(self, name) >= 0, name, "at least 0", getattr(self, name))
        require(0.0 <= self.map_share <= 1.0, "map_share", "a value in [0, 1]", self.map_share)
        enough = not self.fine_weight or self.num_map_points >= self.model.preprocess.max_points
        require(enough, "num_map_points", "at least model.preprocess.max_points", self.num_map_points)
        for name in ("num_steps", "num_evidence_steps"):
            require(getattr(self, name) == 0 or getattr(self, name) >= 10, name, "0 or at least 10", getattr(self, name))
        weights = "matching_weight", "fine_weight", "odometry_weight", "aux_weight", "evidence_weight"
        for name in (*weights, "rotation_regulariser", "translation_regulariser"):
            require(getattr(self, name) >= 0, name, "at least 0", getattr(self, name))
        require(1 <= self.num_iters <= 4, "num_iters", "1 to 4, as many as the loss has weights", self.num_iters)
        require(
            not self.fine_weight or self.model.fine.num_iters > 0, "fine_weight", "0, since the model has no fine stage", self.fine_weight
        )
        normalised = self.model.evidence.head == "embedding" and self.evidence_weight > 0
        require(not normalised or self.batch_size > 1, "batch_size", "at least 2, to normalise the evidence head over", self.batch_size)
        no_head = self.model.evidence.head == "none"
        require(not (no_head and self.evidence_weight), "evidence_weight", "0, since the model has no evidence head", self.evidence_weight)
