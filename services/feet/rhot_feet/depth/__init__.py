"""Feet in the depth image."""
