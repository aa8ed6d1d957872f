"""Plan the next prints and scans, which answer the open questions of a closed loop."""
