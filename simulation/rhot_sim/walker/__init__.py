"""A walking person with a depth camera on the head and inertial sensors on the ankles, from seed and time alone."""
