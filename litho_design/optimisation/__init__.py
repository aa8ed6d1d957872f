"""Free parameters, starts, search and polish; losses over a process window or several models."""
