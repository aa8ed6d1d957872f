"""Dataset cards: what the raw files of a dataset are, where they lie, and which fields they make."""
