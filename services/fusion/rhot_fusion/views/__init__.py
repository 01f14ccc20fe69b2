"""What cameras see: marker views, their geometry, and whether the calibration still holds."""
