"""The unknowns of a hand and the fit of them to its samples."""
