"""Blind boards. A board is a set of dataset stores that the virtual fab (the simulated printer and
microscope) made with hidden causes of error. A closed loop searches each store for causes, and a judge
compares its answers with the hidden causes.
"""
