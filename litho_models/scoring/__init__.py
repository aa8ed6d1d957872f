"""Errors and metrics: of one scan, over scans, between models."""
