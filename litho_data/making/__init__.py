"""From a card to a dataset: operations, jobs, and the store that they make."""
