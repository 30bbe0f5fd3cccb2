"""``taccorl ingest`` and ``ingest inspect`` as typed: words, files and exit codes."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from edited import rewrite
from small_arm import write_hdf5

from taccorl.cli.main import main
from taccorl.surrogate.drivers import CAMERA_TOPICS, PAD_TOPICS
from tests.recordings.stand_in import StandInConfig, write_cobot_magic_hdf5, write_mcap

VERB, IN_PLACE = "ingest", True
SPEC = "--spec=piper_flexitac_mcap"
SMALL: dict[str, Any] = {"duration_s": 2.5, "camera_size": (96, 128)}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("good") / "good.mcap"
    write_mcap(path, StandInConfig(**SMALL))
    return path


@pytest.fixture
def place(tmp_path: Path) -> Path:
    (tmp_path / "here").mkdir()
    return tmp_path / "here"


def tree(folder: Path) -> dict[str, bytes]:
    return {
        str(p.relative_to(folder)): p.read_bytes()
        for p in folder.rglob("*")
        if p.is_file()
    }


# ---- ingest ----


def test_the_command_of_the_readme_says_where_everything_is(good, said):
    before = good.read_bytes()
    code, text = said(good, SPEC, "--out=outputs/my dataset")
    assert (
        code == 0 and "recordings: 1 written, 0 split, 0 quarantined, 0 refused" in text
    )
    assert "report:  outputs/my dataset.ingest_report.json" in text
    assert (
        "taccorl view 'outputs/my dataset' --episode=0" in text
        and "(1 episodes, 70 rows)" in text
    )
    report = json.loads(Path("outputs/my dataset.ingest_report.json").read_text())
    assert report["rows"] == 70
    assert (Path("outputs/my dataset") / "meta/info.json").is_file()
    assert (Path("outputs/store") / "taccorl-store.txt").is_file()
    assert good.read_bytes() == before
    # and again, from elsewhere in words but not in place
    assert said(good, SPEC, "--out=./outputs/../outputs/my dataset")[0] == 0


def test_without_a_spec_the_one_that_fits_is_chosen_and_named(good, said, tmp_path):
    code, text = said(good, "--dry_run=true")
    assert (code, "piper_flexitac_mcap, whose topics these are" in text) == (0, True)
    for verb, words in (
        ("check", ["--pictures=false"]),
        ("view", [f"--save={tmp_path / 'x.rrd'}"]),
    ):
        assert main([verb, str(good), *words]) == 0, verb


def test_without_a_spec_that_fits_the_command_that_drafts_one_is_named(
    tmp_path, said, capsys
):
    path = write_hdf5(
        tmp_path / "own.hdf5",
        {"/qpos": np.zeros((40, 6)), "/command": np.zeros((40, 6))},
    )
    for verb in ("ingest", "check", "view"):
        assert main([verb, str(path)]) != 0
        error = capsys.readouterr().err
        assert (
            f"taccorl ingest inspect {path} --draft=" in error
            and f"taccorl compare {path}" in error
        ), verb
        assert "Traceback" not in error


@pytest.mark.parametrize("dry_run", ["true", "false"])
def test_nothing_fit_means_no_dataset_and_exit_code_1(dry_run, tmp_path, said):
    (folder := tmp_path / "in").mkdir()
    write_mcap(folder / "degrees.mcap", StandInConfig(**SMALL, joints_in_degrees=True))
    (folder / "empty.mcap").touch()
    code, text = said(folder, SPEC, "--out=out", f"--dry_run={dry_run}")
    assert code == 1
    assert "1 quarantined, 1 refused" in text
    for name in ("degrees", "empty"):
        assert f"look: taccorl check {folder / name}.mcap {SPEC}" in text
    assert not Path("out").exists()
    assert Path("out.ingest_report.json").exists() == (dry_run == "false")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--out=.",), "is not the name of a folder"),
        (("--out=..",), "is not the name of a folder"),
        (("--out=store/x", "--store=store"), "contain one another"),
        (("--out=x", "--store=x/store"), "contain one another"),
        (("--out=file/x",), "file is not a folder"),
        (("--store=file/x",), "file is not a folder"),
        (("--out=Anna's data",), "LeRobot cannot work in a folder with '"),
        (("--out=x", "--store=store [1]"), "LeRobot cannot work in a folder with [ ]"),
        (("--out=file",), "is not a dataset of taccorl"),
        (("--out=full",), "is not a dataset of taccorl"),
        (("--store=full",), "is not a taccorl store"),
        (("--out=in",), "is an input, and lies in --out=in"),
        (("--out=in", "--replace=true"), "is an input, and lies in --out=in"),
        (("--out=in/x",), "--out=in/x lies in in, which is read"),
        (("--engine.workers=two",), "engine.workers"),
        (("--egnine.workers=2",), "did you mean 'engine.workers'"),
        (("--spec=nope",), "no spec 'nope'"),
        (("nowhere.mcap",), "nowhere.mcap: no such file or folder"),
    ],
)
def test_what_cannot_work_is_told_before_any_work(
    words, expected, good, said, monkeypatch
):
    Path("file").write_text("x")
    Path("full").mkdir()
    Path("full/mine.txt").write_text("x")
    Path("in").mkdir()
    shutil.copy(good, "in/good.mcap")
    before = tree(Path.cwd())
    monkeypatch.setattr(
        "taccorl.data.ingest.ingest_one", lambda *_: pytest.fail("work was begun")
    )
    spec = () if any(w.startswith("--spec") for w in words) else (SPEC,)
    code, text = said("in", *spec, *words)
    assert code == 2
    assert expected in text
    assert len(text.strip().splitlines()) == 1
    assert tree(Path.cwd()) == before


# ---- inspect ----


def test_inspect_shows_channels_and_names_the_spec_that_fits(good, said):
    code, text = said("inspect", good)
    assert code == 0
    for topic in PAD_TOPICS.values():
        assert topic in text
    assert f"fits the shipped spec: taccorl ingest {good} {SPEC}" in text
    assert "stand-in recording, not a robot" in text
    assert list(Path.cwd().iterdir()) == []


def test_names_that_look_like_markup_are_shown_as_they_are(good, tmp_path, said):
    path = (
        tmp_path / "[red]a[" / "bold].mcap"
    )  # rich would read "[/bold]" as a closing tag
    path.parent.mkdir()
    shutil.copy(good, path)
    code, text = said("inspect", path)
    assert code == 0 and str(path) in text
    code, text = said(path, SPEC, "--dry_run=true")
    assert code == 0 and "[/bold].mcap" in text


# ---- the draft ----


def test_a_draft_never_overwrites(good, said):
    for name in ("mine.yaml", "other_dataset.yaml"):  # either file of the pair
        Path(name).write_text("my work")
        code, text = said("inspect", good, f"--draft={name.replace('_dataset', '')}")
        assert code == 2 and f"{name} exists" in text
        assert Path(name).read_text() == "my work"
    assert not Path("other.yaml").exists()
    Path("dangling.yaml").symlink_to("elsewhere.yaml")
    code, text = said("inspect", good, "--draft=dangling.yaml")
    assert code == 2 and not Path("elsewhere.yaml").exists()


def test_a_draft_into_a_missing_folder_is_one_clear_line(good, said):
    code, text = said("inspect", good, "--draft=nowhere/mine.yaml")
    assert code == 2
    assert "nowhere" in text.strip().splitlines()[-1]


# ---- inspect: folders, and files of other people's kinds ----


def test_one_bad_entry_of_a_folder_does_not_hide_the_others(tmp_path, capsys):
    write_mcap(tmp_path / "good.mcap", StandInConfig(**SMALL))
    (tmp_path / "v21/meta").mkdir(parents=True)
    (tmp_path / "v21/meta/info.json").write_text('{"codebase_version": "v2.1"}')
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "zero.mcap").touch()
    assert (
        main(["ingest", "inspect", str(tmp_path / "missing.mcap"), str(tmp_path)]) == 1
    )
    printed = capsys.readouterr().out
    assert "missing.mcap: no such file" in printed
    assert "piper_flexitac_mcap" in printed
    assert f"{tmp_path}: not read: notes.txt (no recording)" in printed
    assert f"{tmp_path}: not read: v21 (is a LeRobot v2.1 dataset" in printed
    assert f"{tmp_path / 'zero.mcap'}: is empty (0 bytes)" in printed
    assert printed.count("zero.mcap: ") == 1


def test_times_that_the_reader_made_up_are_not_shown_as_measured(tmp_path, capsys):
    write_cobot_magic_hdf5(tmp_path / "a.hdf5", StandInConfig(**SMALL))
    assert main(["ingest", "inspect", str(tmp_path / "a.hdf5")]) == 0
    printed = capsys.readouterr().out
    assert "hdf5, – s" in printed
    [row] = [
        line for line in printed.splitlines() if line.startswith("/observations/qpos")
    ]
    assert row.split() == ["/observations/qpos", "float32", "75", "–", "–", "–", "–"]


def test_what_is_wrong_comes_instead_of_a_spec_that_fits(tmp_path, capsys):
    path = tmp_path / "a.mcap"
    write_mcap(path, StandInConfig(**SMALL, sim_time_stamps=True))
    main(["ingest", "inspect", str(path)])
    printed = capsys.readouterr().out
    assert "fits the shipped spec" not in printed
    assert "has the topics of the shipped spec piper_flexitac_mcap, but" in printed
    assert "stamped in simulation time" in printed


@pytest.mark.parametrize("share", [1.0, 0.6])
def test_drafts_are_printed_of_a_whole_recording_and_a_cut_one_is_named(
    share, tmp_path, capsys
):
    path = tmp_path / "a.mcap"
    write_mcap(tmp_path / "known.mcap", StandInConfig(**SMALL))
    types = {CAMERA_TOPICS["front"]: "foxglove_msgs/msg/CompressedImage"}
    rewrite(tmp_path / "known.mcap", path, list, types=types)
    (tmp_path / "known.mcap").unlink()
    path.write_bytes(path.read_bytes()[: round(share * path.stat().st_size)])
    code, printed = main(["ingest", "inspect", str(path)]), capsys.readouterr().out
    assert "no shipped spec fits" in printed and list(tmp_path.iterdir()) == [path]
    drafts = (
        "dataset: draft_dataset.yaml" in printed
        and "draft_dataset.yaml: what its dataset holds" in printed
    )
    is_named = f"to {path.stat().st_size:,}: the file ends without a footer" in printed
    assert (code, drafts, is_named) == (
        (0, True, False) if share == 1 else (1, False, True)
    )
