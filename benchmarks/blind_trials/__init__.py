"""Blind trials: the closed loop on data of the virtual fab whose hidden effects it is not told."""
