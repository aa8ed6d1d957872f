"""The loop: search the residual of a model on measured prints for causes and empirical laws, and correct the
model with those that are found.
"""
