"""Parts of the search for a layout: the free parameters, the starting layouts, the search loop, the polish,
and losses over a process window or over several models.
"""
