"""Predict the printed heights of whole layouts, tile by tile."""
