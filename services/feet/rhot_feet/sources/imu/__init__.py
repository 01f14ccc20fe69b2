"""Where inertial samples come from: a sensor on a wire, a recording of one, or the simulation."""
