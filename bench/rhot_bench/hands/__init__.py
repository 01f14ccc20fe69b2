"""`rhot evaluate hands`: recorded hand motion."""
