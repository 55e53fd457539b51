"""The errors a user can meet; each message is one sentence: what, expected, got, remedy."""


class DeloError(ValueError):
    """Base of every error this package raises on purpose."""


class ScanError(DeloError):
    """A scan that cannot be used: unreadable file, wrong shape or dtype."""


class ConfigError(DeloError):
    """A configuration value or key that is not allowed."""


class WeightsError(DeloError):
    """Weights that are missing, damaged or made for another model."""


class DatasetError(DeloError):
    """A path that holds no data of a supported layout."""
