"""From the residual of a model on measured prints to causes, laws and a corrected model."""
