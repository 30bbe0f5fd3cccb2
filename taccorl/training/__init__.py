"""Training: datasets of both domains, dataset reader, frame cache, LeRobot's commands as steps."""
