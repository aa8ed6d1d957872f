"""Register AFM scans of printed elements, level them, and find dust on them."""
