"""Registration of a tracking system to the rig."""
