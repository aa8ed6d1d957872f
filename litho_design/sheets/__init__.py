"""Make a sheet of prints for a lab, and evaluate its scans."""
