"""Training on datasets and in the twin."""
