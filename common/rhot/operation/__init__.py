"""Operating a running rig from outside: start and stop, who is alive, its processes."""
