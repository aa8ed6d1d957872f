"""Layouts and the printers that predict their prints: frozen models, nominal heights, and the virtual fab."""
