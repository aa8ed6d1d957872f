"""Move data into and out of a store: release files, and the pair format of the paper's authors."""
