"""The common part of the three command lines: settings as options, progress, errors of one line."""
