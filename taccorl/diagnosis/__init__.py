"""Where the twin fails and why: compare, localise, find the missing effect, say what to record next."""
