"""Design elements that are too large for one process, in bands of rows that several processes share."""
