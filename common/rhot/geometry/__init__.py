"""Rotations, rigid transforms and the camera model."""
