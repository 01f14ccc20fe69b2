"""What the walker's head-worn camera sees."""
