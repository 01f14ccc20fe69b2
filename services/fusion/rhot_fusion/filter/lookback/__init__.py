"""Looking back at a whole recording."""
