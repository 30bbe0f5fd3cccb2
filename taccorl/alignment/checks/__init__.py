"""Checks of measurements before a twin is compared with them: clocks, time stamps, wiring, ranges, repeats."""
