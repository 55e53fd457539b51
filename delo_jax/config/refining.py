"""Config of the refinement by a pose graph."""

import dataclasses

from delo_jax.config.checks import require, require_one_of

GATES = ("band", "none")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RefineConfig:
    """Which pairs of frames are registered beside the odometry, and which of them count."""

    odometry_gap: int = 2
    """Every frame is registered to the one so many frames later, the paper's o; 0: none."""
    key_gap: int = 4
    """Every so many frames is a key frame, registered to the next one, the paper's p; 0: none."""
    gate: str = "band"
    """Which pairs of key frames count: `band`: those outside the band of confidence below; `none`: all."""
    theta_min: float = 0.25
    """Lower end of the band, share of held-out pairs that are doubted more; the paper has 0.2."""
    theta_max: float = 1.0
    """Upper end of the band; the paper has 0.7. At 1 nothing counts as over-confident."""

    def __post_init__(self):
        for name in ("odometry_gap", "key_gap"):
            require(getattr(self, name) >= 0, f"refine.{name}", "0 or more frames", getattr(self, name))
        require_one_of(self.gate, "refine.gate", GATES)
        require(0.0 <= self.theta_min <= self.theta_max <= 1.0, "refine.theta_min", "0 <= theta_min <= theta_max <= 1", self.theta_min)
