"""Tracked objects and the headset: poses in the tracker's space become poses in the rig frame."""
