"""Photo-real worlds drawn from a seed: another rig, hand, paint, light and motion each time, with exact truth."""
