"""Design elements too large for one process, in bands of rows that several processes share."""
