"""Dark level, noise, and what the lens passes to the corners."""
