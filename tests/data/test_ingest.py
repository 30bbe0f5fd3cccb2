"""Recordings into one dataset: every input has one outcome, a second run does only what is new, and nothing is damaged."""

import dataclasses
import json
import os
import resource
import shlex
import shutil
import tempfile
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from edited import NATIVE, SIZE, changed_specs, garbled

from taccorl.cli.main import main
from taccorl.data import ingest as ingest_module
from taccorl.data import lerobot_format
from taccorl.data.cutting import Cutter, open_episodes
from taccorl.data.dataset import Dataset
from taccorl.data.spec import load_recording_spec
from taccorl.errors import DatasetError
from taccorl.lineage.store import Store
from taccorl.surrogate.drivers import CAMERA_TOPICS
from tests.recordings.pictures import read_frame_id
from tests.recordings.stand_in import StandInConfig, write_mcap

pytestmark = pytest.mark.filterwarnings(
    "ignore:This process .* is multi-threaded"
)  # its other threads only wait
GAP = (CAMERA_TOPICS["left_wrist"], 1.8, 2.3)


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped spec with small pictures, so that writing is quick and frame ids can be read."""
    return changed_specs(tmp_path_factory.mktemp("specs"), NATIVE)


def record(path: Path, **config: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_mcap(
        path, StandInConfig(**({"duration_s": 2.5, "camera_size": SIZE} | config))
    )
    return path


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sound recordings."""
    folder = tmp_path_factory.mktemp("good")
    record(folder / "a.mcap", seed=1)
    record(folder / "b.mcap", seed=2)
    return folder


class Ingests:
    """The real command in this process, on one store, with a note of every recording that was really written."""

    def __init__(
        self, folder: Path, spec: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        self.folder, self.spec = folder, spec
        self.out, self.store, self.log = (
            folder / "out",
            folder / "store",
            folder / "written.log",
        )
        original = lerobot_format.write_episodes

        def noted(episodes: Sequence[Any], root: Path, **options: Any) -> None:
            with self.log.open("a") as log:
                log.write(f"{len(episodes)}\n")
            original(episodes, root, **options)

        monkeypatch.setattr(lerobot_format, "write_episodes", noted)

    def words(self, *paths: Path | str, **options: Any) -> list[str]:
        given = {"spec": self.spec, "out": self.out, "store": self.store} | options
        return [
            "ingest",
            *map(str, paths),
            *(f"--{k.replace('__', '.')}={v}" for k, v in given.items()),
        ]

    def run(self, *paths: Path | str, **options: Any) -> int:
        return main(self.words(*paths, **options))

    def report(self) -> dict[str, Any]:
        return json.loads(
            self.out.with_name(f"{self.out.name}.ingest_report.json").read_text()
        )

    def written(self) -> int:
        """Recordings written since last asked."""
        count = len(self.log.read_text().split()) if self.log.exists() else 0
        self.log.unlink(missing_ok=True)
        return count


@pytest.fixture
def ingests(tmp_path: Path, spec: Path, monkeypatch: pytest.MonkeyPatch) -> Ingests:
    return Ingests(tmp_path, spec, monkeypatch)


def content(folder: Path) -> dict[str, bytes]:
    """Every file but the manifest, which says when it was made."""
    files = [p for p in folder.rglob("*") if p.is_file() and p.name != "manifest.json"]
    return {str(p.relative_to(folder)): p.read_bytes() for p in files}


def in_fork(work: Callable[[], int]) -> int:
    """Start ``work`` in a copy of this process; its process id."""
    pid = os.fork()
    if pid:
        return pid
    code = 99
    try:
        code = work()
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


# ---- one outcome each, and a report that adds up ----


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory, spec: Path) -> dict[str, Any]:
    """Four recordings of four outcomes in one command."""
    folder = tmp_path_factory.mktemp("mixed")
    record(
        folder / "in/1_good.mcap",
        duration_s=5.0,
        episodes=2,
        outcomes=("success", "failure"),
        seed=3,
    )
    record(folder / "in/2_gap.mcap", duration_s=4.0, gap=GAP, seed=4)
    record(folder / "in/3_degrees.mcap", duration_s=3.0, joints_in_degrees=True)
    (folder / "in/4_empty.mcap").touch()
    words = [
        "ingest",
        str(folder / "in"),
        f"--spec={spec}",
        f"--out={folder / 'out'}",
        f"--store={folder / 'store'}",
    ]
    code = main(words)
    report = json.loads((folder / "out.ingest_report.json").read_text())
    return {
        "folder": folder,
        "code": code,
        "report": report,
        "dataset": Dataset(folder / "out"),
    }


def test_every_recording_has_exactly_one_outcome(mixed):
    report = mixed["report"]
    assert mixed["code"] == 1
    assert [
        (Path(r["recording"]).stem, r["outcome"]) for r in report["recordings"]
    ] == [
        ("1_good", "written"),
        ("2_gap", "split"),
        ("3_degrees", "quarantined"),
        ("4_empty", "refused"),
    ]
    assert report["outcomes"] == {
        "written": 1,
        "split": 1,
        "quarantined": 1,
        "refused": 1,
    }
    for r in report["recordings"]:
        assert (
            r["reason"]
            == (
                "1 marked as failure (success: false)"
                if r["outcome"] == "written"
                else r["reason"]
            )
            != ""
        )
        assert {
            "spec",
            "spec_digest",
            "part",
            "command",
            "episodes",
            "losses",
            "damage",
            "findings",
        } <= set(r)
        assert "traceback" not in r and "artefact" not in r


def test_counts_in_the_report_are_those_of_the_dataset(mixed):
    report, dataset = mixed["report"], mixed["dataset"]
    episodes = [
        e
        for r in report["recordings"]
        for e in r["episodes"]
        if e["outcome"] == "written"
    ]
    assert [e["index_in_dataset"] for e in episodes] == list(range(4))
    assert report["episodes"] == dataset.num_episodes == 4
    assert (
        report["rows"]
        == sum(e["rows"] for e in episodes)
        == dataset.info["total_frames"]
    )
    assert [dataset.num_rows(e["index_in_dataset"]) for e in episodes] == [
        e["rows"] for e in episodes
    ]
    assert [e["success"] for e in episodes] == [True, False, None, True]
    assert all("index_in_dataset" not in e for e in report["recordings"][2]["episodes"])
    messages = report["recordings"][0]["messages"]
    assert messages["/joint_states_left"] == 1000  # 5 s at 200 Hz


def test_times_in_the_report_count_from_the_recordings_first_sample(mixed):
    first, second = mixed["report"]["recordings"][0]["episodes"]
    # the stand-in's start markers: 0.1 s into each slot of 2.5 s
    assert first["start_s"] == pytest.approx(0.1, abs=0.01)
    assert second["start_s"] == pytest.approx(2.6, abs=0.01)
    before, after = mixed["report"]["recordings"][1]["episodes"]
    [loss] = mixed["report"]["recordings"][1]["losses"]
    assert before["end_s"] < loss["start_s"] <= loss["end_s"] < after["start_s"]
    assert loss["start_s"] - before["end_s"] == pytest.approx(1 / 30, abs=0.002)


def test_the_dataset_holds_what_cutting_gives(mixed, spec):
    dataset, index = mixed["dataset"], 0
    for name in ("1_good", "2_gap"):
        with open_episodes(mixed["folder"] / f"in/{name}.mcap", spec) as episodes:
            for episode in episodes:
                stored = dataset.episode(index)
                for key, values in episode.arrays.items():
                    np.testing.assert_array_equal(stored.arrays[key], values)
                ids = [
                    read_frame_id(shown["observation.images.front"])
                    for shown in episode.pictures()
                ]
                assert [
                    read_frame_id(f)
                    for f in dataset.frames(index, "observation.images.front")
                ] == ids
                assert (stored.instruction, stored.success) == (
                    episode.instruction,
                    episode.success,
                )
                assert stored.start_ns == episode.start_ns
                index += 1
    assert index == dataset.num_episodes and dataset.video_problems() == []


def test_the_named_commands_show_what_is_wrong(mixed, capsys):
    commands = {
        Path(r["recording"]).stem: shlex.split(r["command"])
        for r in mixed["report"]["recordings"]
    }
    for name, words in (
        ("4_empty", "is empty (0 bytes)"),
        ("3_degrees", "degrees?"),
        ("2_gap", "no fresh sample of"),
    ):
        assert main(commands[name][1:]) == 1
        assert words in " ".join(capsys.readouterr().out.split())


def test_an_unfit_recording_without_episodes_is_quarantined(ingests, tmp_path):
    record(tmp_path / "in.mcap", gap=("/left_robot_left_finger", 0.2, 9.0))
    job = ingest_module.find_jobs(
        [tmp_path / "in.mcap"],
        load_recording_spec(ingests.spec),
        "spec",
        tmp_path / "store",
        True,
    )
    [entry] = ingest_module.ingest(job, tmp_path / "out", None)["recordings"]
    assert (entry["outcome"], entry["episodes"]) == ("quarantined", [])
    assert "baseline needs 30" in entry["reason"]


# ---- pictures, watched while they are written ----


def test_a_frozen_camera_is_quarantined_while_a_sound_episode_of_the_same_file_is_kept(
    ingests, tmp_path
):
    # frozen after a third of 6 s; two episodes of 3 s: of the first 1 s is frozen, all of the second
    record(
        tmp_path / "in.mcap",
        duration_s=6.0,
        episodes=2,
        frozen_camera="right_wrist",
        seed=2,
    )
    assert ingests.run(tmp_path / "in.mcap") == 1
    [entry] = ingests.report()["recordings"]
    assert [e["outcome"] for e in entry["episodes"]] == ["written", "quarantined"]
    assert entry["outcome"] == "split" and ingests.report()["episodes_quarantined"] == 1
    assert "1 of 2 episodes quarantined" in entry[
        "reason"
    ] and "right_wrist" in json.dumps(entry["episodes"][1]["findings"])
    assert Dataset(ingests.out).num_episodes == 1


def test_pictures_that_do_not_decode_cost_only_themselves(ingests, tmp_path):
    garbled(record(tmp_path / "whole.mcap"), tmp_path / "in.mcap", (30, 40))
    assert ingests.run(tmp_path / "in.mcap") == 0
    [entry] = ingests.report()["recordings"]
    assert entry["outcome"] == "split"
    assert "2 of front" in entry["reason"]
    assert entry["broken_pictures_s"]["front"] == [
        pytest.approx(1.03, abs=0.06),
        pytest.approx(1.36, abs=0.06),
    ]
    assert entry["losses"] == [], "each row has an older picture of under 80 ms"
    ids = [
        read_frame_id(f)
        for f in Dataset(ingests.out).frames(0, "observation.images.front")
    ]
    assert not {30, 40} & set(ids)
    assert {29, 31, 39, 41} <= set(ids)


def test_a_fault_of_ours_is_told_without_a_traceback_on_the_screen(
    ingests, good, monkeypatch, capsys
):
    original = Cutter.cut

    def faulty(self: Cutter) -> Any:
        return (
            1 // 0 if self.recording.source.name.endswith("a.mcap") else original(self)
        )

    monkeypatch.setattr(Cutter, "cut", faulty)
    assert ingests.run(good) == 1
    bad, other = ingests.report()["recordings"]
    assert (
        bad["outcome"] == "refused"
        and "a fault in taccorl, please report it: ZeroDivisionError" in bad["reason"]
    )
    assert "in faulty" in bad["traceback"]
    assert other["outcome"] == "written", "its neighbour does not suffer"
    shown = capsys.readouterr()
    assert "Traceback" not in shown.out + shown.err


# ---- a second run ----


def test_a_second_run_does_nothing_again_and_of_a_new_recording_only_that_is_written(
    ingests, good, tmp_path
):
    inputs = Path(shutil.copytree(good, tmp_path / "in"))
    assert ingests.run(inputs) == 0
    assert ingests.written() == 2
    files = [
        p for p in (*ingests.store.rglob("*"), *ingests.out.rglob("*")) if p.is_file()
    ]
    # Digests of files that were new when they were read are found, and remembered, once more.
    before = {p: p.stat().st_mtime_ns for p in files if ".digests" not in p.parts}
    report = ingests.report()
    assert ingests.run(inputs) == 0
    assert ingests.written() == 0
    assert {p: p.stat().st_mtime_ns for p in before} == before
    assert ingests.report() == report
    record(inputs / "c.mcap", seed=3)
    assert ingests.run(inputs) == 2, "another dataset is in the way"
    assert ingests.written() == 0, "told before the work, not after it"
    assert ingests.run(inputs, replace="true") == 0
    assert ingests.written() == 1
    assert Dataset(ingests.out).num_episodes == 3
    assert Dataset(tmp_path / "out.old-1").num_episodes == 2
    assert ingests.run(inputs, replace="true") == 0
    assert not (tmp_path / "out.old-2").exists(), (
        "a dataset that is replaced by itself stays where it is"
    )


@pytest.mark.slow
def test_a_changed_spec_writes_all_again(ingests, good, tmp_path, spec):
    assert ingests.run(good) == 0
    assert ingests.written() == 2
    shutil.copytree(spec.parents[1], tmp_path / "specs")
    other = tmp_path / "specs/recordings" / spec.name
    other.write_text("# a comment decides nothing\n" + other.read_text())
    assert ingests.run(good, spec=other) == 0
    assert ingests.written() == 0
    other.write_text(other.read_text().replace("min_s: 1.0", "min_s: 0.5"))
    assert ingests.run(good, spec=other, out=tmp_path / "out2") == 0
    assert ingests.written() == 2


def test_one_file_by_several_names_is_one_input(ingests, good, tmp_path, monkeypatch):
    monkeypatch.chdir(good)
    (tmp_path / "link.mcap").symlink_to(good / "a.mcap")
    assert (
        ingests.run(
            "a.mcap",
            good / "a.mcap",
            "./a.mcap",
            f"../{good.name}/a.mcap",
            tmp_path / "link.mcap",
        )
        == 0
    )
    assert [r["recording"] for r in ingests.report()["recordings"]] == ["a.mcap"]
    assert Dataset(ingests.out).num_episodes == 1


@pytest.mark.slow
def test_names_with_spaces_and_foreign_letters_are_names_like_any_other(
    ingests, good, tmp_path, monkeypatch, capsys
):
    names = ["2024-01-01.mcap", "[bold]it's #1 [].mcap", "über 測試 😀.mcap"]
    folder = tmp_path / "a: b [/c] 'd'"
    folder.mkdir(parents=True)
    for seed, name in enumerate(names, start=20):
        record(folder / name, seed=seed)
    monkeypatch.chdir(folder)
    assert ingests.run(*names, out=tmp_path / "my data/ünï") == 0
    report = json.loads((tmp_path / "my data/ünï.ingest_report.json").read_text())
    assert [r["recording"] for r in report["recordings"]] == names
    shown = capsys.readouterr().out
    for name in names:
        assert name in shown
    for r, name in zip(report["recordings"], names, strict=True):
        assert shlex.split(r["command"])[2] == name


# ---- what is in the way ----


def test_a_foreign_folder_is_refused_before_any_work_and_left_alone(
    ingests, good, capsys
):
    ingests.out.mkdir()
    (ingests.out / "thesis.txt").write_text("do not touch")
    assert ingests.run(good) == 2
    assert "--replace=true" in capsys.readouterr().err
    assert ingests.written() == 0
    assert content(ingests.out) == {"thesis.txt": b"do not touch"}
    assert ingests.run(good / "a.mcap", replace="true") == 0
    aside = ingests.out.with_name("out.old-1")
    assert str(aside) in capsys.readouterr().out
    assert content(aside) == {"thesis.txt": b"do not touch"}


def test_another_dataset_is_left_alone_and_the_same_content_of_another_name_is_known(
    ingests, good, tmp_path, capsys
):
    assert ingests.run(good / "a.mcap") == 0
    assert ingests.written() == 1
    before = content(ingests.out)
    assert ingests.run(good / "b.mcap") == 2
    said = capsys.readouterr().err
    assert (
        "holds another dataset (1 recordings are new, 1 are missing)" in said
        and "--replace=true" in said
    )
    assert content(ingests.out) == before
    shutil.copy(good / "a.mcap", tmp_path / "renamed.mcap")
    assert ingests.run(tmp_path / "renamed.mcap", out=tmp_path / "out2") == 0
    assert ingests.written() == 0
    assert (
        Path(
            Dataset(tmp_path / "out2").episode_facts(0)["provenance"]["recording"]
        ).name
        == "renamed.mcap"
    )
    assert content(tmp_path / "out2/data") == content(ingests.out / "data")


@pytest.mark.slow
def test_a_replacement_that_fails_puts_back_what_was_there(
    ingests, good, monkeypatch, capsys
):
    assert ingests.run(good / "a.mcap") == 0
    before = content(ingests.out)

    def fail(roots: Any, destination: Path) -> None:
        raise DatasetError("3 problems after merging")

    monkeypatch.setattr(lerobot_format, "merge", fail)
    assert ingests.run(good / "b.mcap", replace="true") == 2
    assert "3 problems after merging" in capsys.readouterr().err
    assert content(ingests.out) == before
    assert sorted(
        p.name for p in ingests.folder.iterdir() if p.name.startswith("out")
    ) == ["out", "out.ingest_report.json"]


# ---- dry runs ----


def test_a_dry_run_writes_nothing_at_all(ingests, mixed, monkeypatch, capsys):
    place = ingests.folder / "here"
    scratch = ingests.folder / "scratch"
    place.mkdir()
    scratch.mkdir()
    monkeypatch.chdir(place)
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    assert (
        main(
            [
                "ingest",
                str(mixed["folder"] / "in"),
                f"--spec={ingests.spec}",
                "--dry_run=true",
            ]
        )
        == 1
    )
    assert list(place.iterdir()) == list(scratch.iterdir()) == []
    shown = capsys.readouterr().out
    assert "1 written, 1 split, 1 quarantined, 1 refused" in shown
    assert "nothing was written" in shown


def outcomes(report: dict[str, Any]) -> list[tuple[str, str, str]]:
    return [
        (Path(r["recording"]).name, r["outcome"], r["reason"])
        for r in report["recordings"]
    ]


@pytest.mark.parametrize(
    "feature", ["observation.images/front", "observation.images.front"]
)
def test_a_dry_run_promises_what_the_run_then_does(ingests, good, feature, monkeypatch):
    folder = Path(shutil.copytree(good, ingests.folder / "in"))
    shutil.copy(folder / "b.mcap", folder / "c.mcap")
    spec = load_recording_spec(ingests.spec)
    front = "observation.images.front"
    features = {
        feature if key == front else key: f for key, f in spec.target.features.items()
    }
    contract = dataclasses.replace(
        spec.target, features=features
    )  # past the spec's own check of names
    mapped = {feature if key == front else key: m for key, m in spec.features.items()}
    spec = dataclasses.replace(spec, contract=contract, features=mapped)
    reports = []
    for dry_run in (True, False):
        store = Store(ingests.store)
        jobs = ingest_module.find_jobs([folder], spec, "s", ingests.store, dry_run)
        reports.append(ingest_module.ingest(jobs, ingests.out, store))
    assert outcomes(reports[0]) == outcomes(reports[1])
    # LeRobot refuses a `/` in a feature's name; without it the third recording is the second once more.
    expected = ["refused"] * 3 if "/" in feature else ["written", "written", "refused"]
    assert [outcome for _, outcome, _ in outcomes(reports[0])] == expected
    assert ("the same content as" in reports[0]["recordings"][2]["reason"]) == (
        expected[0] == "written"
    )
    assert ("/" in feature) == (
        "should not contain '/'" in reports[0]["recordings"][0]["reason"]
    )


# ---- the machine fails ----


def _no_damage(ingests: Ingests) -> None:
    assert not ingests.out.exists()
    assert not [
        p for p in ingests.folder.rglob(".*") if p.is_dir() and "taccorl" in p.name
    ]
    assert not list(ingests.store.glob("recording/.*")), "half an artefact"


@pytest.mark.slow
@pytest.mark.parametrize("limit_bytes", [20_000, 120_000])
def test_a_file_that_may_not_grow_stops_the_run_with_one_clear_line(
    ingests, good, limit_bytes, capfd
):
    """As a full disk would: some write fails, in LeRobot's encoder threads or elsewhere."""
    import lerobot.datasets.lerobot_dataset  # noqa: F401  (before the limit: importing writes files, too)

    def limited() -> int:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, limit_bytes))
        return ingests.run(good)

    assert os.waitstatus_to_exitcode(os.waitpid(in_fork(limited), 0)[1]) == 2
    shown = capfd.readouterr()
    assert "Traceback" not in shown.out + shown.err
    last = shown.err.strip().splitlines()[-1]
    assert (
        last.startswith("taccorl ingest: ")
        and "larger than this user may write" in last
    )
    assert "run the same command again" in last
    _no_damage(ingests)
    assert ingests.run(good) == 0, "with room again, it goes on"


def test_a_store_that_is_read_only_is_told_at_once(
    tmp_path, spec, good, monkeypatch, capsys
):
    ingests = Ingests(tmp_path, spec, monkeypatch)
    assert ingests.run(good / "a.mcap", out="/proc/nothing/out") == 2
    assert ingests.run(good / "a.mcap", store="/proc/nothing/store") == 2
    assert ingests.written() <= 1
    assert capsys.readouterr().err.count("taccorl ingest: ") == 2


# ---- many at once ----
