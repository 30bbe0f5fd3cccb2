"""``taccorl check`` on recordings and datasets: its words and its exit codes."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from edited import garbled

from tests.fresh_python import fresh_python
from tests.recordings.stand_in import StandInConfig, write_mcap

VERB = "check"
SPEC = "--spec=piper_flexitac_mcap"


def record(path: Path, **config: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_mcap(
        path, StandInConfig(**({"duration_s": 2.5, "camera_size": (96, 128)} | config))
    )
    return path


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("good") / "good.mcap")


# ---- recordings ----


def test_a_sound_recording_is_ok(good, said):
    code, text = said(good, SPEC)
    assert code == 0
    assert text.count("ok  ") == 2, "the recording and its one episode"
    assert (
        "70 rows, 'insert the test tube into the rack'" in text
    )  # 2.3 s, both ends on a row
    assert "warning" not in text and "error" not in text


def test_a_frozen_camera_is_found_only_when_pictures_are_looked_at(tmp_path, said):
    path = record(tmp_path / "frozen.mcap", duration_s=4.0, frozen_camera="front")
    code, text = said(path, SPEC)
    assert (code, "frozen_picture" in text) == (1, True)
    assert "leave this recording out" in text and "lerobot-edit-dataset" not in text, (
        "no dataset, no command on one"
    )
    code, text = said(path, SPEC, "--pictures=false")
    assert (code, "frozen_picture" in text) == (0, False)


def test_an_episode_that_the_operator_discarded_is_no_warning(tmp_path, said):
    path = record(
        tmp_path / "two.mcap",
        duration_s=4.0,
        episodes=2,
        outcomes=("discard", "success"),
    )
    code, text = said(path, SPEC, "--pictures=false")
    assert code == 0 and "discarded by the operator" in text


def test_pictures_that_do_not_decode_are_named_and_the_rest_is_checked(
    good, tmp_path, said
):
    code, text = said(garbled(good, tmp_path / "broken.mcap", [36]), SPEC)
    assert code == 1
    assert "broken_picture: front: 1 pictures do not decode, first at 1.2" in text
    assert "70 rows" in text


def test_a_bad_file_in_a_folder_does_not_hide_the_others(good, tmp_path, said):
    shutil.copy(good, tmp_path / "b.mcap")
    (tmp_path / "a.mcap").write_bytes(b"not a recording")
    code, text = said(tmp_path, SPEC, "--pictures=false")
    assert code == 1 and "unreadable" in text and "is not an MCAP file" in text
    assert "70 rows" in text


# ---- datasets ----


def test_a_sound_dataset_is_checked_by_the_spec_it_carries(dataset, said):
    code, text = said(dataset)
    assert "episode 0: " in text and "episode 1: " in text
    assert "verified" in text and "files are as they were written" in " ".join(
        text.split()
    )
    assert code == int("warning" in text)
    assert "error" not in text


def test_a_spec_of_another_format_for_a_dataset_is_refused_with_the_way_out(
    dataset, said
):
    code, text = said(dataset, SPEC)
    assert (
        code == 2
        and str(dataset) in text
        and SPEC in text
        and "Leave --spec out" in text
    )


def test_a_cut_video_is_an_error_and_the_other_episodes_are_still_checked(
    dataset, tmp_path, said
):
    copy = Path(shutil.copytree(dataset, tmp_path / "copy"))
    video = next(copy.rglob("videos/observation.images.front/**/*.mp4"))
    os.truncate(video, video.stat().st_size // 2)
    code, text = said(copy)
    assert code == 1
    assert "video_count" in text and "observation.images.front" in text
    assert "episode 0: " in text and "episode 1: " in text


def flip_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize(
    "pattern",
    [
        "data/**/*.parquet",
        "meta/episodes/**/*.parquet",
        "meta/tasks.parquet",
        "videos/**/*.mp4",
        "meta/info.json",
        "meta/taccorl/episodes.json",
    ],
)
def test_one_bit_that_flipped_is_an_error_that_names_the_file(
    pattern, dataset, tmp_path, said
):
    copy = Path(shutil.copytree(dataset, tmp_path / "copy"))
    path = next(copy.glob(pattern))
    flip_bit(path)
    code, text = said(copy, "--pictures=false")
    assert code >= 1
    assert "changed_file" in text and path.relative_to(copy).as_posix() in " ".join(
        text.split()
    )


def test_quick_reads_no_digest(dataset, tmp_path, said):
    copy = Path(shutil.copytree(dataset, tmp_path / "copy"))
    with next(copy.glob("videos/**/*.mp4")).open("ab") as file:
        file.write(b"0")
    assert "changed_file" in said(copy, "--pictures=false")[1]
    assert "changed_file" not in said(copy, "--pictures=false", "--quick=true")[1]


def test_a_file_that_is_gone_is_an_error(dataset, tmp_path, said):
    copy = Path(shutil.copytree(dataset, tmp_path / "copy"))
    (copy / "meta" / "stats.json").unlink()
    code, text = said(copy, "--pictures=false")
    assert code == 1 and "missing_file" in text and "meta/stats.json" in text


@pytest.mark.parametrize("how", ["digest of a file", "not JSON"])
def test_a_damaged_manifest_is_an_error(how, dataset, tmp_path, said):
    copy = Path(shutil.copytree(dataset, tmp_path / "copy"))
    path = copy / "meta" / "taccorl" / "manifest.json"
    if how == "not JSON":
        path.write_bytes(path.read_bytes()[:-40])
    else:
        manifest = json.loads(path.read_text())
        name = next(iter(manifest["files"]))
        manifest["files"][name] = manifest["files"][name][::-1]
        path.write_text(json.dumps(manifest))
    code, text = said(copy, "--pictures=false")
    assert (
        code >= 1
        and "damaged_manifest" in text
        and "manifest.json" in " ".join(text.split())
    )


def test_a_dataset_without_a_manifest_says_that_nothing_was_compared(
    dataset, tmp_path, said
):
    copy = Path(shutil.copytree(dataset, tmp_path / "copy"))
    (copy / "meta" / "taccorl" / "manifest.json").unlink()
    code, text = said(copy, "--pictures=false")
    assert code == 1 and "no_manifest" in text and "changed_file" not in text
    shutil.rmtree(copy / "meta" / "taccorl")  # now it could be anybody's
    text = said(copy, "--pictures=false")[1]
    assert (
        "no manifest of taccorl" in " ".join(text.split()) and "no_manifest" not in text
    )


# ---- what is no recording ----


def test_a_name_that_is_not_in_a_large_folder_does_not_list_it_all(tmp_path, said):
    for k in range(500):
        (tmp_path / f"{k:03d}.mcap").touch()
    (tmp_path / ".000.taccorl-lock").touch()
    code, text = said(tmp_path / "something_else")
    assert (
        code == 2
        and "009.mcap" in text
        and "010.mcap" not in text
        and "490 more" in text
        and ".000" not in text
    )


def odd_things(folder: Path) -> dict[str, Path]:
    (folder / "empty").mkdir()
    (folder / "dir.mcap").mkdir()
    os.mkfifo(folder / "pipe.mcap")
    (folder / "dangling.mcap").symlink_to(folder / "nowhere.mcap")
    (folder / "text.txt").write_text("hello")
    names = [
        "empty",
        "dir.mcap",
        "pipe.mcap",
        "dangling.mcap",
        "text.txt",
        "missing.mcap",
    ]
    return {name: folder / name for name in names}


@pytest.mark.parametrize(
    "name",
    ["empty", "dir.mcap", "pipe.mcap", "dangling.mcap", "text.txt", "missing.mcap"],
)
@pytest.mark.parametrize("with_spec", [True, False])
def test_no_recording_is_one_clear_line_that_names_it(name, with_spec, tmp_path, said):
    path = odd_things(tmp_path)[name]
    if name == "text.txt" and with_spec:
        code, text = said(
            path, SPEC
        )  # the spec names the reader, and the reader says what is wrong with the file
        assert code == 1 and "is not an MCAP file" in text
        return
    code, text = said(path, *([SPEC] if with_spec else []))
    assert code == 2
    assert text.startswith("taccorl check: ") and str(path) in text
    assert len(text.strip().splitlines()) == 1
    if name in ("missing.mcap", "dangling.mcap"):
        assert "no such file" in text
    if name == "dangling.mcap":
        assert "nowhere.mcap" in text  # where the link leads


def test_check_starts_without_torch_or_lerobot(good):
    code = (
        "import sys; from taccorl.cli.main import main\n"
        f"main(['check', {str(good)!r}, {SPEC!r}, '--pictures=false'])\n"
        "print({'torch', 'lerobot', 'rerun'} & set(sys.modules) or 'light')"
    )
    assert fresh_python("-c", code).stdout.splitlines()[-1] == "light"


def test_a_file_that_needs_too_much_memory_is_a_finding(tmp_path, said, monkeypatch):
    from taccorl.data import recording

    def too_much(*_: Any) -> None:
        np.empty(10**15)  # 8 PB

    monkeypatch.setattr(recording, "opened", too_much)
    code, text = said(record(tmp_path / "a.mcap"), SPEC)
    assert code == 1
    assert "unreadable: reading it takes more memory than there is" in text
