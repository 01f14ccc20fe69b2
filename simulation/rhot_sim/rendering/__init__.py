"""Drawing the simulated world."""
