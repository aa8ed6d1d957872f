"""The command line `litho-data`."""
