"""PPO in the twin with a real-data anchor: the paper's post-training (§3.4)."""
