"""The whole hand as one estimate."""
