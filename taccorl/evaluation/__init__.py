"""Scores of policies in the twin: rollouts on given scenes, statistics with intervals, paired comparison."""
