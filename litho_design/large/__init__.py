"""Design elements that are too large for one process. The element is divided into bands of rows, which are
distributed among several processes.
"""
