"""Recordings to datasets: spec, readers, timing, checks, LeRobot format."""
