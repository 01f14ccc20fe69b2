"""The simulated world, a function of seed and time, and the cameras that look at it."""
