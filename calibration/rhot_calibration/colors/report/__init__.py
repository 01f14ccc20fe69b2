"""What a colour calibration shows people."""
