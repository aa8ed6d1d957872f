"""What all packages use: errors, files, hashes, units, records, run facts, commands, reports."""
