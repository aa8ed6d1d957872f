"""Boards: stores of the virtual fab with hidden causes, and the judge of a loop's answers."""
