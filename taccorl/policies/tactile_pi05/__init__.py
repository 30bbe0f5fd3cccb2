"""π0.5 with touch (paper §3.2): LeRobot's own pi05 with changed embeddings of prefix and suffix."""
