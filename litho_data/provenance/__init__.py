"""Trace the origin of every array of a store: list its history, verify it, and replay it."""
