"""What the loop found, for people."""
