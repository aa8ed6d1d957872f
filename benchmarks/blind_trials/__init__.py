"""Run blind trials, in which the closed loop searches for hidden effects in data of the virtual fab."""
