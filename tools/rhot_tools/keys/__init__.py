"""Certificates of a secured bus: the rig's own authority, and what each machine and person gets of it."""
