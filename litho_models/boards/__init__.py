"""Blind boards. A board is a set of dataset stores that the virtual fab (the simulated printer and
microscope) made with hidden causes of error. A closed loop (a search for the effects that a base model lacks)
is run on each store, and its answers are compared with the hidden causes.
"""
