"""The design of elements that are too large for one process. An element is divided into bands of rows, and
several processes share the bands.
"""
