"""Layouts and the printers that print them: frozen models, nominal heights, and the virtual fab."""
