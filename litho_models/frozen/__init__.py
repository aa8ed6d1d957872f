"""Frozen models: card, weights, loading, and the zoo that comes with the package."""
