"""Predict the heights of whole fields, tile by tile."""
