"""Numerical stability as a suite: every stage under hostile inputs, a verdict on each (`relight stress`)."""
