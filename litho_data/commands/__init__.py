"""What the three command lines share: settings as options, progress, and errors of one line."""
