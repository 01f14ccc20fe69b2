"""Whether a trial can be used: have the cameras moved, does the hand fit, how much of it was tracked."""
