"""What every room stands on: errors, files, units, records, commands, reports."""
