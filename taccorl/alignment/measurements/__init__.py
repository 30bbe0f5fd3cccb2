"""Measurements: commands and measured positions from recordings, datasets and tables; their noise floor."""
