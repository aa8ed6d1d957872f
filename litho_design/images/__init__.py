"""Wanted images, photographs of them, and how alike two images are."""
