"""Conversion of joints to the bones of other programs, on plain arrays."""
