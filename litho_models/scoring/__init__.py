"""Figures of merit: of one scan, over scans, between models."""
