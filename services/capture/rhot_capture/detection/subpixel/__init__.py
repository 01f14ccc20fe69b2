"""Sub-pixel centres from the painted share of each pixel."""
