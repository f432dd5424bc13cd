"""ChArUco boards: what they are, on paper, and found in pictures."""
