"""What the loop found, as a record."""
