"""The sweep with which joints are identified. The paper (App. B.1) states its length only; the frequencies are our choice."""

SWEEP_S = 10.0
"""Paper App. B.1."""
SWEEP_HZ = (0.1, 2.5)
"""From, to. A choice: the paper gives no frequencies."""
