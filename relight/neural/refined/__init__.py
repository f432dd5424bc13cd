"""Ours: a small network that adds to the photometric solve what the solve leaves, the presets fast and
balanced."""
