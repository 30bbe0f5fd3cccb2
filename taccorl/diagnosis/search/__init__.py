"""The search for missing effects, the same for joints, axes, pads and cells: fit, screen, validate, accept."""
