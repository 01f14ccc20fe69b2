"""Feet tracked from the head: markers, depth pictures and inertial sensors."""
