"""Boards: stores from the virtual fab with hidden causes, and a judge for the answers of a loop."""
