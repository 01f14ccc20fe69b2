"""What is where at any moment."""
