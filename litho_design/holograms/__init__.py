"""Holograms: their settings, loss and optics, and the task of designing a hologram."""
