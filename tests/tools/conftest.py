"""Rigs and commands of the measurements."""

from running.measuring_fixtures import invoke, rig_path

__all__ = ["invoke", "rig_path"]
