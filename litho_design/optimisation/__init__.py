"""Search for a layout: parameters, starting layouts, polish, and losses over a process window or models."""
