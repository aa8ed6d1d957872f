"""Free parameters, starts, search, polish, and losses over a process window or several models."""
