"""Commands that bring a rig up, start and stop it, and look into it while it runs."""
