"""Pictures of a run. Figures are drawn without a display."""
