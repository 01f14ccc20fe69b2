"""One foot out of everything that is known of it."""
