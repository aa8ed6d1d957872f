"""Divide scans into training, held-out and locked scans."""
