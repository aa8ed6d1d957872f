"""Build a dataset from a card: run operations and jobs, and finish the store."""
