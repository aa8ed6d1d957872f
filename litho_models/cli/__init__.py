"""The command line `litho-models`."""
