"""Figures beside their targets, and where they come from."""
