"""A robot that is not there: a plant of its own with hidden effects, recorded as the real one would be."""
