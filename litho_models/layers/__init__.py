"""Building blocks of models: blurs, pointwise functions and numerical precision."""
