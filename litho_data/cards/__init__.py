"""Dataset cards: descriptions of the raw files of a dataset, their location and their fields."""
