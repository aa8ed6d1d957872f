"""Boards: stores made by the virtual fab with hidden causes, and the judge of what a loop says about them."""
