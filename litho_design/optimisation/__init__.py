"""From a task to a layout: start, search, polish, robustness."""
