"""`rhot evaluate feet`: feet of simulated persons."""
