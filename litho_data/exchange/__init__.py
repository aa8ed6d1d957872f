"""Export a dataset store as files for release, and import and export the format in which the paper's authors
published their data.
"""
