"""Re-implementations of both theses, to compare with."""
