"""Where a flash is and how it shines, from a board with and without it."""
