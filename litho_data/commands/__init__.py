"""What the three command lines share: settings as options, progress, errors of one line."""
