"""Alignment of the twin with a robot: measurements, their checks and noise floor, and identification of parameters."""
