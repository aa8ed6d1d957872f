"""Build a dataset from a card: operations, jobs and the finished store."""
