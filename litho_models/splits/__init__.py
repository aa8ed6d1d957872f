"""Division of scans into training, held-out and locked ones."""
