"""`rhot bench`: what things cost."""
