"""Write files for the printer, each with its sidecar, and read them back."""
