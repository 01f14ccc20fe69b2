"""`rhot evaluate motion`: recorded hand motion before a family of rigs, and what the tracker makes of it."""
