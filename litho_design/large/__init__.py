"""Design elements that exceed one process: in bands of rows, shared among processes."""
