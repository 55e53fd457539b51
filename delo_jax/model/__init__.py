"""The network: the only layer that knows flax."""
