"""Flat lenses: direct focus and imaging with a computer behind."""
