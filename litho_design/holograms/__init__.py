"""Holograms: settings, loss, optics and the task of designing one."""
