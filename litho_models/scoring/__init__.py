"""Compute errors and metrics of one scan, over scans, and between models."""
