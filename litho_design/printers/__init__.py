"""Layouts and the printers that print them: a frozen model, nominal heights, or the virtual fab."""
