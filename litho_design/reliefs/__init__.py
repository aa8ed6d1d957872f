"""Reliefs: layouts whose print is a wanted height map."""
