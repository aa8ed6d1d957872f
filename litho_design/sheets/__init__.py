"""A sheet of prints for a lab to make, and the evaluation of its scans."""
