"""Design elements too large for one process: in bands of rows, shared among processes."""
