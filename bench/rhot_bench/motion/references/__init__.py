"""Simple trackers that every figure is compared with: a plain EKF and a spline per camera."""
