"""Measures of tracked data against truth."""
