"""The stages in order, readable from top to bottom; run from the clone."""
