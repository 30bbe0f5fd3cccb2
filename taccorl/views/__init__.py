"""Rerun and pictures: what an episode looks and feels like."""
