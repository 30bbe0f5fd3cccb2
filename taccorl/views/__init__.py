"""Views of episodes: Rerun, figures and pages."""
