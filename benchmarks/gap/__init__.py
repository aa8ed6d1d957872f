"""Measure the gap between designs and their prints at the paper's size, with the virtual fab as judge."""
