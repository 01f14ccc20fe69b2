"""Fusion by asynchronous filtering."""
