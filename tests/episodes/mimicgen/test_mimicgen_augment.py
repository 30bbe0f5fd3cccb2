"""A dataset out of sources: the same for any number of workers, a run that was killed goes on, other specs never mix with it."""

import os
import shutil
import signal
import sys

import numpy as np
import pytest

from taccorl.data.dataset import Dataset
from taccorl.episodes.attempt import read_json
from taccorl.episodes.produce import produce
from taccorl.episodes.sources.mimicgen.augment import AugmentPlan, attempt_episode
from taccorl.episodes.sources.mimicgen.from_dataset import read_sources
from taccorl.episodes.sources.mimicgen.spec import load_mimic_spec, with_options
from taccorl.errors import InTheWayError, TaccorlError
from taccorl.lineage.engines import LocalEngine, RayEngine
from taccorl.lineage.processes import Failed
from taccorl.lineage.store import Store
from taccorl.sim.simulation import Simulation

PARQUET = "data/chunk-000/file-000.parquet"


@pytest.fixture(scope="module")
def plan(collected, tmp_path_factory):
    sources = Store(tmp_path_factory.mktemp("sources")).dataset(collected)
    usual = {
        "spec": load_mimic_spec("assembly_2"),
        "sources": sources,
        "episodes": 2,
        "images": False,
    }
    return lambda kind=AugmentPlan, **changes: kind(**(usual | changes))


def quiet(_: str) -> None:
    pass


@pytest.fixture(scope="module")
def augmented(plan, tmp_path_factory):
    folder = tmp_path_factory.mktemp("augment")
    return folder, produce(
        plan(), folder / "new", Store(folder / "store"), quiet
    ).report


@pytest.mark.slow
def test_the_dataset_holds_successes_that_say_what_they_are_made_of(
    augmented, collected
):
    folder, report = augmented
    dataset = Dataset(folder / "new")
    assert dataset.num_episodes == report["episodes"] == 2
    names = {
        source.name for source in read_sources(collected, load_mimic_spec("assembly_2"))
    }
    for i in range(2):
        episode = dataset.episode(i)
        assert episode.success
        assert episode.arrays["sim.success"][-1, 0] == 1
        told = episode.provenance["simulation"]
        assert isinstance(told, dict)
        made = told["mimicgen"]
        assert {s["source"] for s in made["subtasks"]} <= names
        assert made["contact_mode"] == "replay"
        assert 0 < made["gates"]["force_n"] < 80
        assert np.shape(made["subtasks"][0]["delta"]) == (4, 4)
    # What was made can be a source itself.
    assert len(read_sources(folder / "new", load_mimic_spec("assembly_2"))) == 2


@pytest.mark.slow
def test_another_spec_never_mixes_with_what_the_store_holds(augmented, plan):
    folder, _ = augmented
    before = sorted((folder / "store" / "mimicgen").iterdir())
    other = plan(
        spec=with_options(load_mimic_spec("assembly_2"), retarget="eef"), episodes=1
    )
    assert other.config(0) != plan().config(0)
    with pytest.raises(InTheWayError):
        produce(other, folder / "new", Store(folder / "store"), quiet)
    assert (
        sorted((folder / "store" / "mimicgen").iterdir()) == before
    )  # refused before the first attempt
    assert Dataset(folder / "new").num_episodes == 2


@pytest.mark.slow
def test_an_attempt_that_breaks_is_counted_and_the_others_go_on(
    plan, tmp_path, monkeypatch
):
    from taccorl.episodes.sources.mimicgen.attempt import Attempts

    run = Attempts.run

    def broken(self, k):
        if k == 0:
            raise ZeroDivisionError("nobody knows")
        return run(self, k)

    monkeypatch.setattr(Attempts, "run", broken)
    report = produce(
        plan(episodes=1), tmp_path / "new", Store(tmp_path / "store"), quiet
    ).report
    assert report["outcomes"]["error"] == 1
    assert (
        "ZeroDivisionError: nobody knows (test_mimicgen_augment.py:"
        in report["entries"][0]["reason"]
    )
    assert report["episodes"] == 1


@pytest.mark.slow
def test_physics_that_ends_in_nan_is_counted_and_leaves_no_trace_in_the_next(
    augmented, plan, tmp_path, monkeypatch
):
    folder, _ = augmented
    step, steps = Simulation.step, []

    def poisoned(self, action, **words):
        steps.append(1)
        if len(steps) == 40:
            self.arrays["qvel"][0, 0] = np.nan
        step(self, action, **words)

    monkeypatch.setattr(Simulation, "step", poisoned)
    report = produce(
        plan(episodes=1), tmp_path / "new", Store(tmp_path / "store"), quiet
    ).report
    assert report["outcomes"] == {"diverged": 1, "success": 1}
    assert report["entries"][0]["rows"] == 40
    of = [
        {
            read_json(path / "entry.json")["attempt"]: np.load(path / "actions.npy")
            for path in (root / "store" / "mimicgen").iterdir()
        }
        for root in (folder, tmp_path)
    ]
    assert np.array_equal(of[1][1], of[0][1])
    assert np.isfinite(of[1][0]).all()
    assert np.isfinite(Dataset(tmp_path / "new").episode(0).arrays["sim.state"]).all()


class Deadly(AugmentPlan):
    """Attempt 0 kills its process, whatever process that is."""

    def run(self, store, item, end=None):
        if item == 0 and end is None:
            os.kill(os.getpid(), signal.SIGSEGV)
        return super().run(store, item, end)


@pytest.mark.slow
def test_an_attempt_that_kills_its_process_twice_is_counted_and_not_made_again(
    augmented, plan, tmp_path, monkeypatch
):
    shutil.copytree(
        augmented[0] / "store", tmp_path / "store"
    )  # it holds attempt 1, which succeeds
    store, some, engine = (
        Store(tmp_path / "store"),
        plan(Deadly, episodes=1),
        LocalEngine(workers=2),
    )
    shutil.rmtree(store.find(some.steps[0].stage, some.config(0), some.inputs(0)).path)
    shutil.rmtree(store.root / "mimicgen_rows")
    done = produce(some, tmp_path / "new", store, quiet, engine)
    assert done.report["outcomes"] == {"crashed": 1, "success": 1}
    crashed = done.report["entries"][0]
    assert (
        crashed["reason"]
        == "the worker process was killed by SIGSEGV while it had this item"
    )
    assert crashed["scene_seed"] == some.scene_seed(0)
    said = "has no actions to show; its outcome is crashed: the worker process"
    with pytest.raises(TaccorlError, match=said):
        attempt_episode(done.made[0].artefact.path)
    assert (
        produce(plan(episodes=1), tmp_path / "new", store, quiet).report == done.report
    )


@pytest.mark.slow
def test_an_attempt_that_hung_is_counted_with_the_limit(plan, tmp_path):
    store, some = Store(tmp_path / "store"), plan(episodes=1)
    end = Failed("no end after 600 s; the worker process was killed", process="hung")
    some.run(store, 0, end)
    report = produce(some, tmp_path / "new", store, quiet).report
    assert report["outcomes"] == {"hung": 1, "success": 1}
    assert (
        report["entries"][0]["reason"]
        == "no end after 600 s; the worker process was killed"
    )


def test_what_hardly_ever_succeeds_is_stopped(plan, tmp_path, monkeypatch):
    monkeypatch.setattr(AugmentPlan, "many", 4)
    monkeypatch.setattr(
        "taccorl.episodes.sources.mimicgen.attempt.Attempts.run", lambda self, k: 1 / 0
    )
    with pytest.raises(
        TaccorlError,
        match=r"assembly_2: 4 of 4 failed \(4 error\); nothing was written.*taccorl view",
    ):
        produce(plan(), tmp_path / "new", Store(tmp_path / "store"), quiet)
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_ray_gives_the_bytes_of_this_process(augmented, plan, tmp_path, monkeypatch):
    ray = pytest.importorskip("ray", reason="extra ray")
    folder, report = augmented
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    ray.init(address="local", num_cpus=2, include_dashboard=False)
    try:
        engine = RayEngine()
        told = produce(
            plan(), tmp_path / "new", Store(tmp_path / "store"), quiet, engine
        ).report
    finally:
        ray.shutdown()
    assert told == report
    assert (tmp_path / "new" / PARQUET).read_bytes() == (
        folder / "new" / PARQUET
    ).read_bytes()
