"""From our joints to the bones of other programs; pure arrays, both hands."""
