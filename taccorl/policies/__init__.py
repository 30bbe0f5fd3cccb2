"""Policies with tactile input, as LeRobot policies."""
