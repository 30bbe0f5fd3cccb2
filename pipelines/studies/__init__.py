"""How often the search is right, on surrogate robots with known hidden effects."""
