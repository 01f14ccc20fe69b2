"""Feet by their square markers."""
