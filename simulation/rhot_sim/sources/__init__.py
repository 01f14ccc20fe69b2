"""Simulated devices behind the services' seams."""
