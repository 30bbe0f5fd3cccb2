"""Policies as small as these are slower with more threads than with one; tests/policies/ and others hold shared makers."""

from pathlib import Path

import pytest
from tiny_dataset import write_tiny

from tests.policies.conftest import one_thread

__all__ = ["one_thread"]


@pytest.fixture(scope="session")
def real(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of three cameras that tests only read."""
    return write_tiny(tmp_path_factory.mktemp("real") / "dataset", cameras=3)
