"""Plan the next prints and scans that answer the open questions of a closed loop."""
