"""`rhot evaluate steps`: feet on real recordings."""
