"""Dataset cards: TOML files that describe a dataset: its raw files, where to find them, and the printed
fields that they show.
"""
