"""Models scored on datasets: evaluation, benchmark, comparison, with their reports."""
