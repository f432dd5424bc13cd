"""A camera's geometry from pictures of a board, and how far to trust it."""
