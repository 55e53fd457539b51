"""Training on simulated worlds: presets, losses, one jitted step, the loop."""
