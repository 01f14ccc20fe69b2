"""`rhot evaluate calibration`: does the calibration still hold?."""
