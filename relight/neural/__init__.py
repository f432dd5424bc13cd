"""Networks that refine a solved portrait: parts that presets share, and a sub-package for each preset."""
