"""Inertial navigation of a foot: strapdown, zero-velocity detection, alignment."""
