"""Running the simulated rig."""
