"""Make reports for people: a page of few parts, and its pictures."""
