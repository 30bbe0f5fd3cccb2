"""Tactile calibration (paper App. B.2): depth of every taxel in a known object, and the law from depth to counts."""
