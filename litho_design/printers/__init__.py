"""What stands for the printer: a frozen model, an ensemble, the virtual fab."""
