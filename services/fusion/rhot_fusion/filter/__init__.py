"""The `filter` method of fusion: one Kalman filter over all markers of a hand."""
