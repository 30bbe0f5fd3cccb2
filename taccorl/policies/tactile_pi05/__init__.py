"""π0.5 with touch (paper §3.2): LeRobot's own pi05, of which only the embedding of prefix and suffix is another one."""
