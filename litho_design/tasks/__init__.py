"""The contract of a task, the run that holograms and lenses share, and the record of a finished design."""
