"""Two collected demonstrations of assembly_2, shared by the tests that need the twin."""

import pytest

from taccorl.demos.collect import Plan, collect
from taccorl.lineage.store import Store


@pytest.fixture(scope="session")
def collected(tmp_path_factory):
    """Folder of a dataset with two episodes, without pictures."""
    folder = tmp_path_factory.mktemp("mimicgen_sources")
    plan = Plan(task="assembly_2", episodes=2, images=False, seed=3)
    collect(plan, folder / "dataset", Store(folder / "store"), lambda _: None)
    return folder / "dataset"
