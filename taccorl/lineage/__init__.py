"""What was made from what: a content-addressed store, explained, on any engine."""
