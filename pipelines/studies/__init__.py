"""How often the search is right, on surrogate robots with known hidden effects."""

import os

# Before NumPy is imported, here and in every worker: threads of linear algebra that wait for each other take 1.5 to 4 times the
# CPU time of one (four diagnoses of pipelines.studies.robots on two cores).
for _library in ("OMP", "OPENBLAS", "MKL"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")
