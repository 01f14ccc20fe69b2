"""`rhot evaluate pictures`: the whole tracker on photo-real pictures of a rig and a hand that nobody tuned to."""
