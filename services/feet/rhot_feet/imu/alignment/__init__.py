"""How an inertial sensor sits on its foot."""
