"""Raw AFM files and layouts in, a dataset with provenance out."""
