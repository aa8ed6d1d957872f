"""What to print and scan next, so that what a closed loop left open is decided."""
