"""Blind trials: the closed loop searches for hidden effects in data of the virtual fab."""
