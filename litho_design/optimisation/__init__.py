"""Search for a layout: free parameters, starting layouts, polish, and losses over a process window or over
several models.
"""
