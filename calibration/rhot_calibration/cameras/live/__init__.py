"""Collecting board views from running cameras."""
