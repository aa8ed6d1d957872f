"""The interface of a task, the run that all tasks share, and the record of a finished design."""
