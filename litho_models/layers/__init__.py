"""Building blocks of the models: blurs, functions of one value, the precision of products."""
