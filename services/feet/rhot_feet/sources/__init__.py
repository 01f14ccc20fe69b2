"""Where depth frames and inertial samples come from."""
