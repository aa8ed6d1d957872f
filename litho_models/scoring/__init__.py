"""Score predictions: compute the errors and metrics of a model on one scan and over many scans, and compare
models.
"""
