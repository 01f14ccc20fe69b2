"""FABRIK with joint limits."""
