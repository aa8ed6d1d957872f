"""Dataset cards: TOML files that describe the raw files of a dataset, where they are, and the printed fields
that they show.
"""
