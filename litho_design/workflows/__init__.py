"""Functions that design, score and compare elements. Each of them writes one folder with a record and a
report.
"""
