"""Comparing what was tracked with what was true."""
