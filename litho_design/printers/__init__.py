"""Layouts and what prints them: a frozen model, nominal heights, or the virtual fab."""
