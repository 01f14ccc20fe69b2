"""Detection of markers in a frame."""
