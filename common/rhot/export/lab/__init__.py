"""Files of biomechanics: TRC and MOT for OpenSim, C3D."""
