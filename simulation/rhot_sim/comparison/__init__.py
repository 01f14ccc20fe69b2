"""Comparing a running rig with the simulated truth."""
