"""Find causes and laws in the residual of a model on measured prints, and correct the model."""
