"""Controller identification (paper App. B.1) and the one-joint model that it runs thousands of times."""
