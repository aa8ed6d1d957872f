"""Design, score and compare: each function writes one folder with a record and a report."""
