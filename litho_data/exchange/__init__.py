"""Ways in and out of a dataset: known datasets, releases, the pair format."""
