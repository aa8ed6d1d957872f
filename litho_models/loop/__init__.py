"""Find causes and empirical laws in the residual of a model on measured prints, and correct the
model with them.
"""
