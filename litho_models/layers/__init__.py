"""Building blocks of the models: blurs and functions of one value."""
