"""Score models on datasets: evaluation, benchmark and comparison, with their reports."""
