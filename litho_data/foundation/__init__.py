"""Parts that all packages use: errors, files, hashes, units, records, and facts about a run."""
