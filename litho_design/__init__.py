"""Diffractive optics designed through a frozen model of the printer."""
