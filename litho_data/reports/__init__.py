"""Reports for people: a page of few parts, and its pictures."""
