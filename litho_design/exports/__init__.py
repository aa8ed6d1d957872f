"""Write files for the printer, each with a sidecar file that describes it, and read these files back."""
