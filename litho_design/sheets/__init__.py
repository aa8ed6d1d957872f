"""A sheet of prints for a lab to make, and what its scans say when they come back."""
