"""Elements larger than one process: in bands of rows, shared among processes."""
