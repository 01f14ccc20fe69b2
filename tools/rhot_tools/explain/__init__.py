"""`rhot explain`: why a moment of a recording was tracked as it was."""
