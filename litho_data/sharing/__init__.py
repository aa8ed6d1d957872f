"""Independent jobs shared among processes and machines."""
