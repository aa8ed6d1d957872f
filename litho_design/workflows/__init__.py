"""What a user calls: design, compare and score; each writes one folder with a record and a report."""
