"""Printing the feet's markers."""
