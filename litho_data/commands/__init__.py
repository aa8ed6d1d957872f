"""What the three command lines share: settings as options, progress, and one-line errors."""
