"""A dataset out of sources: the same for any number of workers, a run that was killed goes on, other specs never mix with it."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from taccorl.data.dataset import Dataset
from taccorl.demos.mimicgen import augment as module
from taccorl.demos.mimicgen.augment import AugmentPlan, attempt_episode, augment, made_attempts, run_attempt
from taccorl.demos.mimicgen.coverage import read_attempts
from taccorl.demos.mimicgen.from_dataset import read_sources
from taccorl.demos.mimicgen.report import numbers
from taccorl.demos.mimicgen.spec import load_mimic_spec, with_options
from taccorl.errors import InTheWayError, TaccorlError
from taccorl.lineage.engines import LocalEngine, RayEngine
from taccorl.lineage.processes import Failed
from taccorl.lineage.store import Store
from taccorl.sim.simulation import Simulation

PARQUET = "data/chunk-000/file-000.parquet"


def plan(**changes):
    return AugmentPlan(**({"spec": load_mimic_spec("assembly_2"), "episodes": 2, "images": False} | changes))


@pytest.fixture(autouse=True)
def small_rounds(monkeypatch):
    monkeypatch.setattr(module, "_ROUND", 2)


@pytest.fixture(scope="module")
def augmented(collected, tmp_path_factory):
    folder = tmp_path_factory.mktemp("augment")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_ROUND", 2)
        report = augment(plan(), collected, folder / "new", Store(folder / "store"), progress=lambda _: None)
    return folder, report


@pytest.mark.slow
def test_the_dataset_holds_successes_that_say_what_they_are_made_of(augmented, collected):
    folder, report = augmented
    dataset = Dataset(folder / "new")
    assert dataset.num_episodes == report["episodes"] == 2
    names = {source.name for source in read_sources(collected, load_mimic_spec("assembly_2"))}
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
def test_another_spec_never_mixes_with_what_the_store_holds(augmented, collected, tmp_path):
    folder, _ = augmented
    before = sorted((folder / "store" / "mimicgen").iterdir())
    other = plan(spec=with_options(load_mimic_spec("assembly_2"), retarget="eef"), episodes=1)
    with pytest.raises(InTheWayError):
        augment(other, collected, folder / "new", Store(folder / "store"), progress=lambda _: None)
    after = sorted((folder / "store" / "mimicgen").iterdir())
    assert set(before) < set(after)
    assert Dataset(folder / "new").num_episodes == 2


@pytest.mark.slow
def test_an_attempt_that_breaks_is_counted_and_the_others_go_on(collected, tmp_path, monkeypatch):
    from taccorl.demos.mimicgen.attempt import Attempts

    run = Attempts.run

    def broken(self, k):
        if k == 0:
            raise ZeroDivisionError("nobody knows")
        return run(self, k)

    monkeypatch.setattr(Attempts, "run", broken)
    report = augment(plan(episodes=1), collected, tmp_path / "new", Store(tmp_path / "store"), progress=lambda _: None)
    assert report["outcomes"]["error"] == 1
    assert "ZeroDivisionError: nobody knows (test_mimicgen_augment.py:" in report["entries"][0]["reason"]
    assert report["episodes"] == 1


@pytest.mark.slow
def test_physics_that_ends_in_nan_is_counted_and_leaves_no_trace_in_the_next_attempt(
    augmented, collected, tmp_path, monkeypatch
):
    folder, _ = augmented
    step, steps = Simulation.step, []

    def poisoned(self, action, **words):
        steps.append(1)
        if len(steps) == 40:
            self.arrays["qvel"][0, 0] = np.nan
        step(self, action, **words)

    monkeypatch.setattr(Simulation, "step", poisoned)
    report = augment(plan(episodes=1), collected, tmp_path / "new", Store(tmp_path / "store"), progress=lambda _: None)
    assert report["outcomes"] == {"diverged": 1, "success": 1}
    assert report["entries"][0]["rows"] == 40
    actions = [
        np.load(made.folder / "actions.npy") for made in made_attempts(plan(), collected, Store(folder / "store"), 2)
    ]
    mine = [
        np.load(made.folder / "actions.npy") for made in made_attempts(plan(), collected, Store(tmp_path / "store"), 2)
    ]
    assert np.array_equal(mine[1], actions[1])
    assert np.isfinite(mine[0]).all()
    assert np.isfinite(Dataset(tmp_path / "new").episode(0).arrays["sim.state"]).all()


def deadly_attempt(some, sources, store, k, end=None):
    """Attempt 0 kills its process, whatever process that is."""
    if k == 0 and end is None:
        os.kill(os.getpid(), signal.SIGSEGV)
    return run_attempt(some, sources, store, k, end)


@pytest.mark.slow
def test_an_attempt_that_kills_its_process_twice_is_counted_and_never_made_again(
    augmented, collected, tmp_path, monkeypatch
):
    shutil.copytree(augmented[0] / "store", tmp_path / "store")  # it holds attempt 1, which succeeds
    monkeypatch.setattr(module, "run_attempt", deadly_attempt)
    store, some, engine = Store(tmp_path / "store"), plan(episodes=1), LocalEngine(workers=2)
    shutil.rmtree(made_attempts(some, collected, store, 1)[0].folder)
    report = augment(some, collected, tmp_path / "new", store, engine, progress=lambda _: None)
    assert report["outcomes"] == {"crashed": 1, "success": 1}
    crashed = report["entries"][0]
    assert crashed["reason"] == "the worker process was killed by SIGSEGV while it had this item"
    assert crashed["scene_seed"] == some.scene_seed(0)
    folder = made_attempts(some, collected, store, 2)[0].folder
    with pytest.raises(
        TaccorlError,
        match="attempt 0 has no actions to show; its outcome is crashed: the worker process was killed by SIGSEGV",
    ):
        attempt_episode(folder)
    monkeypatch.setattr(module, "run_attempt", run_attempt)
    assert augment(some, collected, tmp_path / "new", store, progress=lambda _: None) == report
    told = numbers(some, read_attempts(some, collected, store, 2), None)
    assert told["failures"] == {"crashed": 1}
    assert told["failed"][0]["command"] is None
    with pytest.raises(TaccorlError, match="3 attempts are requested, but 1 successes were reached after 2"):
        made_attempts(some, collected, store, 3)


@pytest.mark.slow
def test_an_attempt_that_hung_is_counted_with_the_limit(collected, tmp_path):
    store, some = Store(tmp_path / "store"), plan(episodes=1)
    end = Failed("no end after 600 s; the worker process was killed", process="hung")
    run_attempt(some, store.source(collected), store, 0, end)
    report = augment(some, collected, tmp_path / "new", store, progress=lambda _: None)
    assert report["outcomes"] == {"hung": 1, "success": 1}
    assert report["entries"][0]["reason"] == "no end after 600 s; the worker process was killed"


def test_what_hardly_ever_succeeds_is_stopped(collected, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_HUNDRED", 4)
    monkeypatch.setattr("taccorl.demos.mimicgen.attempt.Attempts.run", lambda self, k: 1 / 0)
    with pytest.raises(TaccorlError, match=r"assembly_2: 0 of 4 attempts succeeded, nothing was written .*'error': 4"):
        augment(plan(), collected, tmp_path / "new", Store(tmp_path / "store"), progress=lambda _: None)
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_two_workers_give_the_bytes_of_one(augmented, collected, tmp_path):
    folder, report = augmented
    engine = LocalEngine(workers=2)
    told = augment(plan(), collected, tmp_path / "new", Store(tmp_path / "store"), engine, progress=lambda _: None)
    assert told == report
    assert (tmp_path / "new" / PARQUET).read_bytes() == (folder / "new" / PARQUET).read_bytes()


@pytest.mark.slow
def test_ray_gives_the_bytes_of_this_process(augmented, collected, tmp_path, monkeypatch):
    ray = pytest.importorskip("ray", reason="extra cluster: ray")
    pytest.importorskip("datatrove.executor", reason="extra cluster: datatrove")
    folder, report = augmented
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    ray.init(address="local", num_cpus=2, include_dashboard=False)
    try:
        engine = RayEngine(work_dir=tmp_path / "work", mem_per_cpu_gb=2)
        told = augment(plan(), collected, tmp_path / "new", Store(tmp_path / "store"), engine, progress=lambda _: None)
    finally:
        ray.shutdown()
    assert told == report
    assert (tmp_path / "new" / PARQUET).read_bytes() == (folder / "new" / PARQUET).read_bytes()


@pytest.mark.slow
def test_a_run_that_is_killed_goes_on_and_gives_the_same_bytes(augmented, collected, tmp_path):
    folder, report = augmented
    script = (
        "from pathlib import Path; from taccorl.demos.mimicgen import augment as m\n"
        "from taccorl.demos.mimicgen.spec import load_mimic_spec; from taccorl.lineage.store import Store\n"
        "m._ROUND = 2\n"
        "m.augment(m.AugmentPlan(spec=load_mimic_spec('assembly_2'), episodes=2, images=False), "
        f"Path({str(collected)!r}), Path({str(tmp_path / 'new')!r}), Store(Path({str(tmp_path / 'store')!r})))\n"
    )
    rng = np.random.default_rng(0)
    for _ in range(4):
        with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.DEVNULL) as process:
            time.sleep(float(rng.uniform(4, 12)))
            os.kill(process.pid, signal.SIGKILL)
    told = augment(plan(), collected, tmp_path / "new", Store(tmp_path / "store"), progress=lambda _: None)
    assert json.dumps(told) == json.dumps(report)
    assert (tmp_path / "new" / PARQUET).read_bytes() == (folder / "new" / PARQUET).read_bytes()
