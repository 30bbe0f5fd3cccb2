"""Which motion or press to record next, to separate rival effects."""
