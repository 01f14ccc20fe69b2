"""`rhot evaluate tracking`: the simulated rig, offline."""
