"""Policies that feel, as LeRobot policies."""
