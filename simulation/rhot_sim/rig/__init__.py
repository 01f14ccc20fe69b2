"""The simulated rig: cameras, clocks, schedules, its folder."""
