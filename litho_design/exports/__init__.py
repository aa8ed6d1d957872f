"""Files for the printer, each with its sidecar, and the way back."""
