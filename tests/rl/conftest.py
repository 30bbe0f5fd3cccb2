"""Policies as small as these are slower with more threads than with one; tests/policies/ and others hold shared makers."""

from tests.policies.conftest import one_thread

__all__ = ["one_thread"]
