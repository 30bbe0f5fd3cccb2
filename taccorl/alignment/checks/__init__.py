"""Checks of measurements before the twin is blamed: clocks, time stamps, wiring, ranges, repeats."""
