"""Hips and legs from the head and the feet."""
