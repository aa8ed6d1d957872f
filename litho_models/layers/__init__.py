"""Building blocks of models: Gaussian blurs, functions that act on each pixel separately, ranges of fitted
values, and the numerical precision of networks.
"""
