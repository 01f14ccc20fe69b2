"""The anatomy of hands and bodies: joints, proportions, forward kinematics."""
