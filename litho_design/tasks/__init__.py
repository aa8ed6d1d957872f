"""What is designed for: settings, targets, and the run that every task shares."""
