"""Dataset cards, which describe the raw files of a dataset, their location and their fields."""
