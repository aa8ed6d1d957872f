"""What single scans add, tested and seen."""
