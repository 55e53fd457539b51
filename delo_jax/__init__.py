"""LiDAR odometry in JAX: poses without a motion prior, each with a covariance and a status.

Names are imported when they are first used: `import delo_jax` alone starts nothing.
"""

import importlib
from typing import TYPE_CHECKING, Any

from delo_jax.errors import ConfigError, DatasetError, DeloError, ScanError, WeightsError

if TYPE_CHECKING:
    from delo_jax.data.dataset import open_dataset
    from delo_jax.data.scans import read_scan
    from delo_jax.inference import Estimate, odometry
    from delo_jax.model.delo import Model
    from delo_jax.pipeline.lidar_odometry import Frame, LidarOdometry
    from delo_jax.preprocess import Scan
    from delo_jax.weights import load, save

__version__ = "0.1.0"
__all__ = [
    "ConfigError",
    "DatasetError",
    "DeloError",
    "Estimate",
    "Frame",
    "LidarOdometry",
    "Model",
    "Scan",
    "ScanError",
    "WeightsError",
    "__version__",
    "load",
    "odometry",
    "open_dataset",
    "read_scan",
    "save",
]
_MODULES = {
    "Estimate": "inference",
    "Frame": "pipeline.lidar_odometry",
    "LidarOdometry": "pipeline.lidar_odometry",
    "Model": "model.delo",
    "Scan": "preprocess",
    "load": "weights",
    "odometry": "inference",
    "open_dataset": "data.dataset",
    "read_scan": "data.scans",
    "save": "weights",
}


def __getattr__(name: str) -> Any:
    """The public name, imported from the module that has it."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))
