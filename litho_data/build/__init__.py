"""From a card to a dataset: listing, jobs, operations, and the store that comes out."""
