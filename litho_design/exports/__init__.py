"""Files for the printer, each with its sidecar, and reading them back."""
