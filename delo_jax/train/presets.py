"""Named training runs."""

from delo_jax.config import TrainConfig

PRESETS = {"base": TrainConfig()}
