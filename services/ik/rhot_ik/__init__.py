"""Inverse kinematics: from points in space to hands."""
