"""Who made which array from what: records, history, verification, replay."""
