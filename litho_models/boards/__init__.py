"""Blind boards. A board is a set of dataset stores simulated by the virtual fab with hidden causes. A judge
compares the answers of a loop with these causes.
"""
