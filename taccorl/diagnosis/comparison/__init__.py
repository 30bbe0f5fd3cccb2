"""Replay of measurements in the twin, the residuals, and where they are large."""
