"""Measure the design-to-manufacturing gap at the paper's size, with the virtual fab as judge."""
