"""Measurements: what was commanded and what was measured, from recordings, datasets and tables; their noise floor."""
