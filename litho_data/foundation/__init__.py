"""Parts that all packages use: errors, files, hashes, units, records, run facts."""
