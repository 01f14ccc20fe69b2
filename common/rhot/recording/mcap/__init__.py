"""Messages of a running rig in MCAP files."""
