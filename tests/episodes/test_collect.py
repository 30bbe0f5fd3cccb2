"""Collecting demonstrations: a dataset that LeRobot reads and a run that goes on where it was stopped; recordings that ingest
reads back."""

import math
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from taccorl.cli.main import main as cli
from taccorl.data.dataset import Dataset
from taccorl.data.origin import Origin
from taccorl.episodes.attempt import Attempt, Source, Targets, outcome_of
from taccorl.episodes.plan import Listed, Made, Needed
from taccorl.episodes.produce import produce
from taccorl.episodes.recorder import EpisodeRecorder, row_spec
from taccorl.episodes.sources.collect import CollectPlan, attempt, collect_recordings
from taccorl.errors import InTheWayError, TaccorlError, UnreachableError
from taccorl.lineage.engines import LocalEngine
from taccorl.lineage.stage import Artefact
from taccorl.lineage.store import Store
from taccorl.robots import ROBOT
from taccorl.surrogate.drivers import CAMERA_TOPICS
from taccorl.surrogate.twin_recording import LEAD_S, TwinStory
from taccorl.training.frame_cache import resized
from taccorl.training.rendered_frames import render_frames

ARGUMENTS = ("--task=assembly_1", "--episodes=1", "--images=false", "--seed=5")


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    folder = tmp_path_factory.mktemp("collect")
    assert (
        cli(
            [
                "collect",
                *ARGUMENTS,
                f"--out={folder / 'a'}",
                f"--store={folder / 'store'}",
            ]
        )
        == 0
    )
    return folder


def test_dataset_holds_successes_with_state_seed_and_subtasks(collected):
    dataset = Dataset(collected / "a")
    assert dataset.num_episodes == 1
    episode = dataset.episode(0)
    assert episode.success
    assert episode.origin == Origin("twin", "MuJoCo twin, not a robot")
    assert (
        episode.arrays["sim.success"][-1, 0] == 1
        and episode.arrays["sim.state"].dtype == np.float64
    )
    assert len(set(episode.arrays["sim.seed"][:, 0])) == 1 and episode.stages
    simulation = episode.provenance["simulation"]
    assert isinstance(simulation, dict)
    assert simulation["task"] == "assembly_1"


def test_an_episode_of_the_dataset_can_be_done_again_from_what_it_holds(collected):
    episode = Dataset(collected / "a").episode(0)
    sim = CollectPlan(task="assembly_1").make()
    sim.reset(episode.arrays["sim.seed"][0])
    np.testing.assert_array_equal(sim.state_rows()[0], episode.arrays["sim.state"][0])
    for sent in episode.arrays["sim.executed"]:
        sim.step(sent[None].astype(float))
    assert sim.judge.outcome.success[0]


def test_labels_have_no_aiming_error_and_what_was_sent_is_kept_beside_them(collected):
    arrays = Dataset(collected / "a").episode(0).arrays
    off = np.abs(arrays["sim.executed"] - arrays["action"])
    off_rad = off[:, ROBOT.joint_indices]
    assert off_rad.max() > 0.005  # tremor of 4 mrad in rotation, aim of 15 mrad
    assert np.median(off_rad) < 0.01
    for arm in ROBOT.arms:
        assert not off[:, ROBOT.gripper_index(arm)].any()


@pytest.mark.slow
def test_frames_drawn_beside_attempts_survive_a_kill_and_are_those_drawn_afterwards(
    tmp_path,
):
    words = [
        "collect",
        "--task=assembly_1",
        "--episodes=3",
        "--seed=5",
        "--pictures=cache",
        "--resolution=28x28",
    ]
    words += [
        "--engine.workers=2",
        f"--out={tmp_path / 'a'}",
        f"--store={tmp_path / 'store'}",
    ]
    with subprocess.Popen(
        [sys.executable, "-m", "taccorl.cli.main", *words], stdout=subprocess.DEVNULL
    ) as process:
        while not (
            drawn := list((tmp_path / "store" / "frames").glob(".*/*front.npy"))
        ):
            assert process.poll() is None
            time.sleep(0.05)
        process.kill()
    assert (
        not (tmp_path / "a").exists() and drawn[0].is_file()
    )  # attempts were still running
    assert cli(words) == 0
    (folder,) = (
        tmp_path / "store" / "frames"
    ).iterdir()  # what the dead run drew is gone
    afterwards, _ = render_frames(
        tmp_path / "a",
        (28, 28),
        Store(tmp_path / "other"),
        LocalEngine(),
        lambda _: None,
    )
    made = sorted(path.name for path in afterwards.path.glob("*.npy"))
    assert len(made) == 3
    for name in made:
        assert (folder / name).read_bytes() == (afterwards.path / name).read_bytes()


@pytest.mark.slow
def test_every_third_row_has_a_picture_in_the_cache_and_part_poses_beside_it(
    tmp_path, capsys
):
    words = [
        "collect",
        "--task=assembly_1",
        "--episodes=2",
        "--seed=5",
        "--source.hands.pulse_rad=0.02",
    ]
    words += ["--pictures=cache", "--resolution=28x28", "--part_poses=true"]
    assert (
        cli([*words, f"--out={tmp_path / 'a'}", f"--store={tmp_path / 'store'}"]) == 0
    )
    dataset = Dataset(tmp_path / "a")
    assert dataset.rows_per_picture == 3
    assert dataset.info["features"]["observation.environment_state"]["shape"] == [
        18
    ]  # two parts, nine numbers each
    expected = sum(math.ceil(dataset.num_rows(i) / 3) for i in range(2))
    (front,) = (tmp_path / "store" / "frames").glob("*/observation.images.front.npy")
    frames = np.load(front, mmap_mode="r")
    assert frames.shape == (expected, 3, 28, 28)
    sim = CollectPlan(task="assembly_1").make()
    states = dataset.values(1, ["sim.state"])["sim.state"]
    (picture,) = sim.render_states(states[6:7], ["front"])
    np.testing.assert_array_equal(
        frames[math.ceil(dataset.num_rows(0) / 3) + 2],
        resized(picture["front"][None], (28, 28))[0],
    )
    capsys.readouterr()  # one episode more: the frames of the others are copied
    words = ["--episodes=3" if word == "--episodes=2" else word for word in words]
    assert (
        cli([*words, f"--out={tmp_path / 'b'}", f"--store={tmp_path / 'store'}"]) == 0
    )
    shown = capsys.readouterr().out
    assert [
        f"episode {i} of 3: {how}" in shown
        for i, how in enumerate(("copied", "copied", "rendered"))
    ] == [True] * 3
    (more,) = set(
        (tmp_path / "store" / "frames").glob("*/observation.images.front.npy")
    ) - {front}
    np.testing.assert_array_equal(np.load(more, mmap_mode="r")[:expected], frames)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--pictures=vidoe"], "did you mean 'video'"),
        (["--rows_per_picture=3"], "rows_per_picture=3 needs --pictures=cache"),
        (["--pictures=cache", "--images=false"], "contradict one another: remove one"),
        (
            ["--pictures=cache", "--rows_per_picture=-1"],
            "rows_per_picture=-1: at least 1",
        ),
        (["--pictures=cache", "--as_recording=true"], "as_recording"),
    ],
)
def test_ways_to_store_pictures_that_do_not_exist_are_refused(
    words, said, tmp_path, capsys
):
    assert (
        cli(
            [
                "collect",
                "--task=assembly_1",
                *words,
                f"--out={tmp_path / 'a'}",
                f"--store={tmp_path / 's'}",
            ]
        )
        == 2
    )
    assert said in capsys.readouterr().err


@pytest.mark.slow
def test_same_command_elsewhere_in_two_processes_gives_the_same_bytes(
    collected, tmp_path
):
    words = ["collect", *ARGUMENTS, "--episodes=3"]
    for name, *engine in (("a",), ("b", "--engine.workers=2")):
        assert (
            cli(
                [
                    *words,
                    f"--out={tmp_path / name}",
                    f"--store={tmp_path / name}_store",
                    *engine,
                ]
            )
            == 0
        )
    for name in (
        "data/chunk-000/file-000.parquet",
        "meta/stats.json",
        "meta/info.json",
        "meta/taccorl/collect_report.json",
    ):
        assert (tmp_path / "b" / name).read_bytes() == (
            tmp_path / "a" / name
        ).read_bytes()


def made(outcome: str) -> Made:
    return Made(Artefact(Path(), ""), {"outcome": outcome})


FATE = ["success", "rim", "rim", "success", "rim", "success", "success", "never run"]


@pytest.mark.parametrize("at_once", [1, 3, 50])
def test_no_attempt_is_run_that_may_not_be_needed_in_whatever_order_they_end(at_once):
    """4 successes of FATE are 0, 3, 5, 6: attempt 6 is started when 5 have ended, whose successes are 0, 3, 5 at most."""
    for seed in range(20):
        rng, needed = (
            np.random.default_rng(seed),
            Needed(CollectPlan(task="assembly_1", episodes=4), at_once),
        )
        waiting, running, ended = list(needed.first()), [], []
        assert waiting == [0, 1, 2, 3]
        while waiting or running:
            while waiting and len(running) < at_once:
                running.append(waiting.pop(0))
            k = running.pop(rng.integers(len(running)))
            ended.append(k)
            waiting += needed.after(k, made(FATE[k]))
            failures = sum(FATE[j] != "success" for j in ended)
            assert len(ended) + len(running) + len(waiting) == 4 + failures
        assert sorted(ended) == [0, 1, 2, 3, 4, 5, 6]


def test_of_many_attempts_at_once_no_more_are_started_than_show_whether_it_is_hopeless():
    needed = Needed(CollectPlan(task="assembly_1", episodes=1000), at_once=30)
    assert needed.first() == range(
        49
    )  # when 20 have ended, 29 are enough for 30 processes but for one
    for k in range(20, 49):
        assert not needed.after(k, made("success"))
    for k in range(19):
        assert not needed.after(k, made("rim" if k < 10 else "success"))
    assert needed.after(19, made("success")) == range(
        49, 1010
    )  # 10 of the first 49 failed, 961 successes are missing
    hopeless = Needed(
        CollectPlan(task="assembly_1", episodes=1000),
        at_once=30,
        advice=lambda made: f"see {made.entry}",
    )
    assert hopeless.first() == range(49)
    for k in range(4):
        hopeless.after(k, made("success"))
    for k in range(19, 4, -1):
        hopeless.after(k, made("rim"))
    with pytest.raises(
        TaccorlError,
        match=r"16 of 20 failed \(16 rim, 4 success\); see {'outcome': 'rim'}",
    ):
        hopeless.after(4, made("rim"))


def test_a_twin_that_changes_during_the_run_is_not_mixed_with_the_one_before(tmp_path):
    """A process that has made the simulation keeps it; one that makes it later must not take another twin."""
    twin = tmp_path / "twin.yaml"
    twin.write_text(
        "physics: {steps_per_control_step: 60}\n"
    )  # of no other test: its simulation is not made yet
    plan = CollectPlan(task="assembly_1", twin=twin, images=False)
    assert "60" in plan.scene["twin"]
    twin.write_text("physics: {steps_per_control_step: 20}\n")
    with pytest.raises(TaccorlError, match=r"twin\.yaml was changed"):
        plan.run(Store(tmp_path / "store"), 0)
    assert not list((tmp_path / "store").rglob("entry.json"))


def test_an_engine_for_what_has_an_order_is_refused(tmp_path, capsys):
    for words in (["--as_recording=true"], ["--source.type=leader"]):
        assert (
            cli(
                [
                    "collect",
                    *ARGUMENTS,
                    *words,
                    f"--out={tmp_path / 'x'}",
                    "--engine.workers=2",
                ]
            )
            == 2
        )
        assert "--engine" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


@pytest.mark.slow
def test_more_episodes_go_on_from_those_in_the_store(collected, tmp_path):
    began = []
    plan = CollectPlan(task="assembly_1", episodes=2, images=False, seed=5)
    store = Store(collected / "store")
    before = {path.name for path in (collected / "store").rglob("entry.json")}
    produce(plan, tmp_path / "more", store, began.append)
    assert len(began) >= 2
    assert before
    more, first = Dataset(tmp_path / "more"), Dataset(collected / "a")
    np.testing.assert_array_equal(
        more.episode(0).arrays["sim.state"], first.episode(0).arrays["sim.state"]
    )
    demonstrations = list((collected / "store").rglob("entry.json"))
    assert len(demonstrations) == len(began)  # nothing was done twice


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("--task=asembly_1", "assembly_1"),
        ("--difficulty=hart", "hard"),
        ("--episodes=0", "--episodes=0: at least 1"),
        ("--seed=-1", "--seed=-1: at least 0"),
        ("--randomization=-0.1", "reset ranges, 0 to 1"),
        ("--randomization=1.5", "--randomization=1.5: give a share"),
        ("--randomization=nan", "reset ranges, 0 to 1"),
    ],
)
def test_wrong_words_are_answered_with_the_right_one(word, said, capsys, tmp_path):
    words = [w for w in ARGUMENTS if w.split("=")[0] != word.split("=")[0]]
    assert (
        cli(
            [
                "collect",
                *words,
                word,
                f"--out={tmp_path / 'x'}",
                f"--store={tmp_path / 's'}",
            ]
        )
        == 2
    )
    assert said in capsys.readouterr().err


def never(*_):
    raise AssertionError("an attempt was made")


def test_what_is_in_the_way_is_refused_before_the_first_attempt(
    collected, tmp_path, monkeypatch
):
    monkeypatch.setattr(CollectPlan, "make", never)
    store, out = Store(tmp_path / "store"), tmp_path / "out"
    out.mkdir()
    (out / "notes.txt").write_text("keep me")
    with pytest.raises(
        InTheWayError,
        match=r"out is occupied: it is a folder of 1 entries without a taccorl manifest",
    ):
        produce(CollectPlan(task="assembly_1"), out, store)
    with pytest.raises(
        InTheWayError, match=r"notes.txt is occupied: it is a file without"
    ):
        produce(CollectPlan(task="assembly_1"), out / "notes.txt", store)
    (out / "assembly_1_007.part").touch()  # a killed run leaves it
    for path, why in (
        (out / "notes.txt", "already;"),
        (out, r"already, assembly_1_007\.part .* may be deleted;"),
    ):
        with pytest.raises(TaccorlError, match=f"holds files {why}"):
            collect_recordings(CollectPlan(task="assembly_1"), path)
    (out / "assembly_1_007.part").unlink()
    assert (out / "notes.txt").read_text() == "keep me"
    assert list(out.iterdir()) == [out / "notes.txt"]


@pytest.mark.parametrize(
    ("other", "differs"),
    [
        ({"episodes": 3}, "attempts"),
        ({"seed": 6}, "attempts"),
        ({"difficulty": "easy"}, "attempts"),
        ({"randomization": 0.5}, "attempts"),
        ({"keep_failures": True}, "attempts"),
        ({"part_poses": True}, "attempts"),
        (
            {"images": True, "pictures": "cache", "rows_per_picture": 3},
            "pictures, rows_per_picture",
        ),
    ],
)
def test_another_collection_is_refused_before_the_first_attempt(
    collected, tmp_path, monkeypatch, other, differs
):
    monkeypatch.setattr(CollectPlan, "make", never)
    plan = CollectPlan(
        **({"task": "assembly_1", "episodes": 1, "images": False, "seed": 5} | other)
    )
    with pytest.raises(
        InTheWayError, match=f"holds collection v3, .* differs in {differs}[ ;]"
    ):
        produce(plan, collected / "a", Store(tmp_path / "store"))


@pytest.mark.slow
def test_the_same_command_again_with_a_new_store_finds_its_dataset(
    collected, tmp_path, capsys
):
    shutil.copytree(collected / "a", tmp_path / "a")
    before = (tmp_path / "a" / "meta" / "taccorl" / "manifest.json").read_bytes()
    assert (
        cli(
            [
                "collect",
                *ARGUMENTS,
                f"--out={tmp_path / 'a'}",
                f"--store={tmp_path / 'store'}",
            ]
        )
        == 0
    )
    assert (
        tmp_path / "a" / "meta" / "taccorl" / "manifest.json"
    ).read_bytes() == before
    assert (
        f"dataset, made before: {tmp_path / 'a'}" in (said := capsys.readouterr().out)
        and "took:" not in said
    )


@Source.register_subclass("idle_in_test")
@dataclass(frozen=True, kw_only=True)
class Idle(Source):
    """Looks at the scene for a moment and gives up."""

    def actions(self, sim, rng):
        for _ in range(3):
            yield Targets(*2 * [sim.targets[0].astype(np.float32)])


def test_a_hopeless_demonstrator_is_stopped(tmp_path):
    plan = CollectPlan(task="assembly_1", source=Idle(), images=False, episodes=30)
    with pytest.raises(TaccorlError, match=r"20 of 20 failed \(20 unfinished\)"):
        produce(plan, tmp_path / "x", Store(tmp_path / "store"), lambda _: None)
    assert not (tmp_path / "x").exists()


@Source.register_subclass("stretched_in_test")
@dataclass(frozen=True, kw_only=True)
class Stretched(Source):
    """Wants a pose out of reach after ``rows`` steps."""

    rows: int = 3
    repeatable = False  # so that it may fail as often as it likes

    def actions(self, sim, rng):
        for _ in range(self.rows):
            yield Targets(*2 * [sim.targets[0].astype(np.float32)])
        raise UnreachableError("left arm: TCP at [9, 9, 9] m is out of reach")


@dataclass(frozen=True, kw_only=True)
class Three(CollectPlan):
    """Three attempts."""

    def schedule(self, at_once):
        return Listed(range(3))


@pytest.mark.parametrize("rows", [3, 0])
def test_a_pose_out_of_reach_ends_its_attempt_and_no_other(tmp_path, rows):
    plan = Three(
        task="assembly_1", source=Stretched(rows=rows), images=False, keep_failures=True
    )
    if not rows:  # nothing to keep: ended before the first row
        sim = plan.make()
        done = attempt(plan, sim, row_spec(sim, pictures=False), 0)
        assert (done.outcome, done.rows, plan.keeps(plan.entry(0, done))) == (
            "unreachable",
            0,
            False,
        )
        return
    report = produce(
        plan, tmp_path / "x", Store(tmp_path / "store"), lambda _: None
    ).report
    assert report["outcomes"] == {"unreachable": 3}
    assert [entry["seed"] for entry in report["entries"]] == [
        plan.attempt_seed(k) for k in range(3)
    ]
    assert "out of reach" in report["entries"][0]["reason"]
    dataset = Dataset(tmp_path / "x")
    assert [
        (dataset.episode(k).success, dataset.episode(k).num_rows) for k in range(3)
    ] == [(False, 3)] * 3


# recordings ---------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def told():
    plan = CollectPlan(task="assembly_1", seed=5)
    sim = plan.make()
    spec = row_spec(sim, pictures=False)
    recorder = attempt(plan, sim, spec, 0, dense=True).recorder
    assert outcome_of(sim) == "success"
    return sim, recorder, TwinStory(sim, recorder.trajectory(), "success")


@pytest.mark.slow
def test_a_recording_tells_the_trajectory_at_its_own_times(told):
    _, recorder, story = told
    rows = recorder.episode("x", {}).arrays["observation.state"]
    time_s = LEAD_S + np.arange(len(rows)) / 30
    # between 200 Hz samples, moving at up to 1 rad/s
    np.testing.assert_allclose(story.at("state", time_s), rows, atol=2e-4)
    np.testing.assert_allclose(
        story.at("state", np.array([0.0, LEAD_S / 2]))[0], rows[0], atol=1e-6
    )  # rest before


@pytest.mark.slow
def test_pads_of_a_recording_read_what_the_sensor_reads_in_wire_order(told):
    sim, recorder, story = told
    trajectory = recorder.trajectory()
    loudest = int(trajectory.reading.sum(axis=(1, 2, 3)).argmax())
    counts = story.clean_counts(
        "right_robot_left_finger", np.array([LEAD_S + trajectory.time_s[loudest]])
    )[0]
    expected = sim.sensor.clean_counts(trajectory.reading[loudest, 2])  # right_a
    np.testing.assert_allclose(counts, expected.T, atol=1e-4)
    assert counts.max() > 45  # more than 10 N


@pytest.mark.slow
def test_a_recording_of_the_twin_is_ingested_with_its_touch(tmp_path):
    (path,) = collect_recordings(
        CollectPlan(task="assembly_1", episodes=1, seed=5),
        tmp_path / "mcap",
        lambda _: None,
    )
    assert path.name == "assembly_1_000.mcap"
    with path.open("rb") as file:
        topics = list(CAMERA_TOPICS.values())
        messages = [
            (c.topic, m.log_time) for _, c, m in make_reader(file).iter_messages(topics)
        ]
    for topic in topics:
        steps_s = (
            np.diff([time_ns for name, time_ns in messages if name == topic]) * 1e-9
        )
        assert len(steps_s) > 100
        # none was lost: at 30 Hz, with 4 ms of jitter in the latency, a lost one leaves 67 ms
        assert steps_s.max() < 0.058
    out = tmp_path / "dataset"
    code = cli(
        [
            "ingest",
            str(path),
            "--spec=piper_flexitac_mcap",
            f"--out={out}",
            f"--store={tmp_path / 'store'}",
        ]
    )
    assert code == 0
    episode = Dataset(out).episode(0)
    assert episode.origin == Origin(
        "surrogate", "recording of the MuJoCo twin, not a robot"
    )
    assert episode.success
    assert episode.arrays["observation.tactile"].max() > 45
    assert cli(["check", str(out)]) == 0


def test_recordings_are_counted_by_their_successes(tmp_path, monkeypatch):
    ends = iter(["timeout", "success", "unreachable", "drop", "success", "success"])

    def told_end(plan, sim, spec, k, *, dense):
        end = next(ends)
        recorder = EpisodeRecorder(sim, spec, rows=[] if end == "unreachable" else [{}])
        return Attempt(outcome=end, recorder=recorder)

    monkeypatch.setattr("taccorl.episodes.sources.collect.attempt", told_end)
    successes = []

    def write(path, sim, trajectory, *, success, origin):
        path.parent.mkdir(exist_ok=True)
        path.touch()
        successes.append(success)

    monkeypatch.setattr("taccorl.episodes.sources.collect.write_twin_mcap", write)
    monkeypatch.setattr(EpisodeRecorder, "trajectory", lambda self: None)
    plan = CollectPlan(task="assembly_1", episodes=2, keep_failures=True)
    written = collect_recordings(plan, tmp_path / "mcap", lambda _: None)
    assert successes == [False, True, False, True]
    assert [path.name for path in written] == [
        f"assembly_1_{k:03d}.mcap" for k in range(4)
    ]
    assert next(ends) == "success"  # the last one was not needed
