"""Making the twin match: measurements of a robot, how far they can be trusted, and what is fitted to them."""
