"""The command line `litho-design`."""
