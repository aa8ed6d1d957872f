"""Building blocks of models: blurs, pointwise functions, numerical precision."""
