"""Colour classes: samples, fit, quality, separability."""
