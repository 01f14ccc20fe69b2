"""Recordings for Foxglove and Lichtblick."""
