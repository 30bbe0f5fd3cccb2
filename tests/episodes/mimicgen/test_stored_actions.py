"""Demonstrations stored as seeds and actions, and executed again: the same attempts and numbers, and what differs is counted."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from taccorl.data.dataset import Dataset
from taccorl.data.origin import TWIN_ORIGIN, Origin
from taccorl.episodes.plan import REPORT
from taccorl.episodes.produce import Produced, produce
from taccorl.episodes.recorder import origin_told, told_origin
from taccorl.episodes.sources.mimicgen.augment import AugmentPlan
from taccorl.episodes.sources.mimicgen.execute import ExecutePlan, stored_sources
from taccorl.episodes.sources.mimicgen.spec import DisturbanceSpec, load_mimic_spec, with_options
from taccorl.episodes.sources.mimicgen.stored import ACTIONS, META, SIMULATION, Demonstration, read_stored, write_stored
from taccorl.errors import DatasetError, InTheWayError, TaccorlError
from taccorl.lineage.store import Store

PARQUET = "data/chunk-000/file-000.parquet"
SPEC = with_options(load_mimic_spec("assembly_2"), disturbance=DisturbanceSpec(joint_rad=0.02))


def quiet(_: str) -> None:
    pass


def written(folder: Path, rows: tuple[int, ...] = (3, 2), disturbed: bool = True, origin: Origin = TWIN_ORIGIN) -> Path:
    """Stored actions that nothing has made."""
    folder.mkdir(parents=True)
    rng, made = np.random.default_rng(0), []
    for k, num in enumerate(rows):
        actions = rng.normal(size=(num, 14)).astype(np.float32)
        demonstration = Demonstration(
            attempt=3 * k,
            scene_seed=2**61 + k,
            actions=actions,
            intended=actions + 1 if disturbed else None,
            last_state=f"{k:064x}",
            provenance={"attempt": 3 * k},
        )
        made.append(demonstration)
    simulation = dict.fromkeys(SIMULATION, "x") | {"randomization": 1.0} | told_origin(origin)
    write_stored(folder, simulation, {"gates": {"max_force_n": 5.0}}, {"episodes": len(rows)}, made)
    return folder


@pytest.mark.parametrize("disturbed", [False, True])
def test_what_is_read_is_what_was_written(tmp_path, disturbed):
    stored = read_stored(written(tmp_path / "a", disturbed=disturbed))
    assert [len(d.actions) for d in stored.demonstrations] == [3, 2]
    expected = np.random.default_rng(0).normal(size=(5, 14)).astype(np.float32)
    np.testing.assert_array_equal(np.concatenate([d.actions for d in stored.demonstrations]), expected)
    first, second = stored.demonstrations
    assert (second.attempt, second.scene_seed, second.last_state) == (3, 2**61 + 1, f"{1:064x}")
    assert stored.is_disturbed == disturbed
    if disturbed:
        np.testing.assert_array_equal(first.intended, first.actions + 1)
    else:
        assert first.intended is None
    assert stored.gates.max_force_n == 5.0
    assert stored.meta["action_time"] == "next_row"


def test_the_origin_is_kept_and_one_dataset_has_one(tmp_path):
    robot = Origin("surrogate", "made up, not a robot")
    twin, surrogate = written(tmp_path / "twin"), written(tmp_path / "surrogate", origin=robot)
    assert origin_told(read_stored(twin).simulation) == TWIN_ORIGIN
    assert origin_told(read_stored(surrogate).simulation) == robot
    said = r"surrogate is surrogate: made up, not a robot, .*twin is twin: MuJoCo twin, not a robot: .*merge"
    with pytest.raises(DatasetError, match=said):
        ExecutePlan(sources=stored_sources((twin, surrogate), Store(tmp_path / "store")))


def test_what_is_damaged_is_named(tmp_path):
    with pytest.raises(DatasetError, match=r"no meta\.json.*taccorl augment --rows=actions"):
        read_stored(tmp_path)
    short = written(tmp_path / "short")
    np.save(short / ACTIONS, np.zeros((4, 14), np.float32))
    with pytest.raises(DatasetError, match=r"actions\.npy: float32 \[4, 14\], meta\.json says float32 \[5, 14\]"):
        read_stored(short)
    other = written(tmp_path / "other")
    meta = json.loads((other / META).read_text())
    (other / META).write_text(json.dumps(meta | {"format": 9}))
    with pytest.raises(DatasetError, match="format 9"):
        read_stored(other)
    episode = {k: v for k, v in meta["episodes"][1].items() if k != "rows"}
    (other / META).write_text(json.dumps(meta | {"episodes": [meta["episodes"][0], episode]}))
    with pytest.raises(DatasetError, match="episode 1 has no rows"):
        read_stored(other)
    (other / META).write_text(json.dumps({k: v for k, v in meta.items() if k not in ("twin", "action_time")}))
    with pytest.raises(DatasetError, match="has no twin, action_time"):
        read_stored(other)
    (other / META).write_text(json.dumps(meta | {"action_time": "this_row"}))
    with pytest.raises(DatasetError, match="action_time this_row"):
        read_stored(other)
    with pytest.raises(TaccorlError, match=r"--rows=action: .*actions"):
        AugmentPlan(spec=SPEC, rows="action")  # pyright: ignore[reportArgumentType]
    with pytest.raises(TaccorlError, match=r"--pictures=vidio: .*video"):
        ExecutePlan(sources=stored_sources([written(tmp_path / "sound")], Store(tmp_path / "store")), pictures="vidio")  # pyright: ignore[reportArgumentType]


def plan(store: Store, collected: Path, rows: str = "actions") -> AugmentPlan:
    return AugmentPlan(spec=SPEC, sources=store.dataset(collected), episodes=2, images=False, rows=rows)


def executed(root: Path, out: Path, store: Store, **changes: str) -> Produced:
    return produce(ExecutePlan(sources=stored_sources([root], store), **changes), out, store, quiet)


@pytest.fixture(scope="module")
def made(collected, tmp_path_factory):
    """A folder with actions/, and dataset/ of the same attempts out of the same store."""
    folder = tmp_path_factory.mktemp("stored")
    store = Store(folder / "store")
    for rows in ("actions", "dataset"):
        produce(plan(store, collected, rows), folder / rows, store, quiet)
    return folder


@pytest.mark.slow
def test_both_forms_are_of_the_same_attempts_and_executing_gives_the_bytes_of_the_dataset(made, collected):
    stored = read_stored(made / "actions")
    attempts = len(list((made / "store" / "mimicgen").iterdir()))
    assert stored.meta["report"]["attempts"] <= attempts < 2 * stored.meta["report"]["attempts"]
    for i, demonstration in enumerate(stored.demonstrations):
        episode = Dataset(made / "dataset").episode(i)
        np.testing.assert_array_equal(episode.arrays["sim.executed"], demonstration.actions)
        np.testing.assert_array_equal(episode.arrays["action"], demonstration.intended)
        assert episode.provenance["simulation"]["mimicgen"] == demonstration.provenance
    store = Store(made / "elsewhere")
    first, again = (executed(made / "actions", made / "again", store, pictures="none") for _ in range(2))
    assert (first.report["episodes"], first.report["differs"], first.report["dropped"]) == (2, 0, {})
    assert set(first.seconds) == {"physics", "touch", "writing"}
    assert (made / "again" / PARQUET).read_bytes() == (made / "dataset" / PARQUET).read_bytes()
    assert again.report == first.report and again.seconds == {}, "a second run makes nothing"
    assert json.loads((made / "again" / "meta/taccorl" / REPORT).read_text()) == first.report


@pytest.mark.slow
def test_what_does_not_succeed_here_is_dropped_and_counted_and_a_bit_that_differs_is_counted(made, tmp_path):
    changed, store = shutil.copytree(made / "actions", tmp_path / "changed"), Store(tmp_path / "store")
    (changed / "manifest.json").unlink()  # a source of its own: made elsewhere
    meta = json.loads((changed / META).read_text())
    meta["episodes"][0]["last_state"] = "0" * 64  # another CPU's
    (changed / META).write_text(json.dumps(meta))
    actions = np.load(changed / ACTIONS)
    actions[meta["episodes"][0]["rows"] :] = actions[meta["episodes"][0]["rows"]]  # the second one stands still
    np.save(changed / ACTIONS, actions)
    report = executed(changed, tmp_path / "new", store, pictures="none").report
    assert (report["demonstrations"], report["episodes"], report["differs"]) == (2, 1, 2)
    assert sum(report["dropped"].values()) == 1
    episode = Dataset(tmp_path / "new").episode(0)
    assert episode.provenance["simulation"]["mimicgen"]["last_state_differs"] is True
    with pytest.raises(InTheWayError):
        executed(made / "actions", tmp_path / "new", store)
    spoilt = shutil.copytree(made / "actions", tmp_path / "spoilt")
    (spoilt / ACTIONS).chmod(0o644)
    np.save(spoilt / ACTIONS, actions)
    with pytest.raises(DatasetError, match="its files were changed"):
        stored_sources([spoilt], store)
