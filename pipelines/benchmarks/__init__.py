"""Benchmarks of ``make bench``: a module of this folder registers them by ``@benchmark`` (``rows``)."""
