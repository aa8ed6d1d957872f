"""Build a dataset from a dataset card: process every scan, and write the store and its report."""
