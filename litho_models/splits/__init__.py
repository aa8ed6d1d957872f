"""Which scans are learned from, which are held out, which stay locked."""
