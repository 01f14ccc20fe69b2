"""Sub-pixel centres from how much of each pixel is paint."""
