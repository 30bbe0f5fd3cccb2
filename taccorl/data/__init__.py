"""From recording to dataset: spec, readers, timing, checks, LeRobot format."""
