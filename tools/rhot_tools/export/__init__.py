"""Recordings as what other programs read: tables of numbers and skeleton animations."""
