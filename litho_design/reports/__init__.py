"""Write HTML reports of designs, scores and comparisons."""
