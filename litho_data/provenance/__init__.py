"""Trace the origin of every array of a store: list the steps that made it, verify its hash, and recompute it
from the raw files.
"""
