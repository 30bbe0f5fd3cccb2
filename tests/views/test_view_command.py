"""``taccorl view`` on a real dataset and a real recording of the stand-in, as a user types it."""

import os
import resource
import shlex
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path
from urllib.parse import urlparse

import numpy as np
import pytest
from PIL import Image

from taccorl.cli.main import main
from taccorl.data.dataset import Dataset

from .readback import read_rrd

SPEC = "--spec=piper_flexitac_mcap"


@pytest.fixture(scope="module")
def recording(recordings: Path) -> Path:
    return sorted(recordings.glob("*.mcap"))[0]


def test_dataset_becomes_an_rrd_with_its_own_numbers_and_pictures(
    dataset: Path, tmp_path: Path, capsys
):
    out = tmp_path / "episode.rrd"
    assert main(["view", str(dataset), "--episode=1", f"--save={out}"]) == 0
    assert f"wrote {out}" in capsys.readouterr().out
    found, episode = read_rrd(out), Dataset(dataset).episode(1)
    frames = found["/observation/images/front"]["EncodedImage:blob"]
    assert frames.frame_index == list(range(episode.num_rows))
    shown = np.array(
        [
            v[0]
            for v in found["/observation/tactile/left_a"]["DepthImage:buffer"].values
        ],
        dtype=np.uint8,
    )
    pad = episode.pads("observation.tactile")["left_a"]
    assert np.array_equal(shown.reshape(pad.shape), np.clip(pad, 0, 255))
    page = found["/provenance"]["TextDocument:text"].values[0][0]
    assert page.startswith("**data: surrogate: stand-in recording, not a robot**")
    assert "| left_a | asof |" in page


def test_recording_is_shown_without_a_dataset(
    recording: Path, dataset: Path, tmp_path: Path
):
    out = tmp_path / "episode.rrd"
    assert main(["view", str(recording), SPEC, f"--save={out}"]) == 0
    found, episode = read_rrd(out), Dataset(dataset).episode(0)
    pictures = found["/observation/images/left_wrist"]["EncodedImage:blob"]
    assert pictures.frame_index == list(range(episode.num_rows))
    grippers = np.array(
        found["/observation/state/grippers_m"]["Scalars:scalars"].values,
        dtype=np.float32,
    )
    assert np.array_equal(grippers, episode.arrays["observation.state"][:, [6, 13]])


def test_recording_beside_an_episode_of_a_dataset(
    recording: Path, dataset: Path, tmp_path: Path
):
    out = tmp_path / "pair.rrd"
    words = [
        str(recording),
        SPEC,
        f"--against={dataset}",
        "--against_episode=1",
        "--align=contact",
        f"--save={out}",
    ]
    assert main(["view", *words]) == 0
    found = read_rrd(out)
    for root, episode in (
        ("a", Dataset(dataset).episode(0)),
        ("b", Dataset(dataset).episode(1)),
    ):
        column = found[f"/{root}/curves/observation/state/left_gripper_m"][
            "Scalars:scalars"
        ]
        values = np.array(column.values, dtype=np.float32)[:, 0]
        assert np.array_equal(values, episode.arrays["observation.state"][:, 6])
    page = found["/pair"]["TextDocument:text"].values[0][0]
    assert page.count("surrogate: stand-in recording, not a robot") == 2
    assert str(recording) in page and "dataset episode 1" in page


def test_recorded_actions_in_the_twin_begin_where_they_were_recorded(
    dataset: Path, tmp_path: Path
):
    """The arms of the stand-in rest at first, as do the twin's; later they move apart, because no physics made the stand-in."""
    out, twin = tmp_path / "pair.rrd", tmp_path / "twin.yaml"
    twin.write_text("effects: []\n")
    assert main(["view", str(dataset), f"--against={twin}", f"--save={out}"]) == 0
    found = read_rrd(out)
    a, b = (
        np.array(
            found[f"/{root}/curves/observation/state/left_joint_2_rad"][
                "Scalars:scalars"
            ].values
        )[:, 0]
        for root in "ab"
    )
    assert (
        len(a) == len(b) == Dataset(dataset).num_rows(0)
        and np.abs(a - b)[:10].max() < 2e-3
    )
    assert 0.01 < np.abs(a - b).max() < 0.3
    assert "/b/touch/sum/left_a" not in found, "an empty bench has nothing to touch"
    page = found["/pair"]["TextDocument:text"].values[0][0]
    assert (
        f"replayed in {twin}" in page and "twin: replay of: stand-in recording" in page
    )


def test_sheet_of_a_part_holds_that_part(dataset: Path, tmp_path: Path):
    out = tmp_path / "sheet.png"
    assert (
        main(["view", str(dataset), f"--sheet={out}", "--start_s=1", "--end_s=2"]) == 0
    )
    with Image.open(out) as image:
        assert image.info["Title"].endswith("episode 0, 1.00 to 2.00 s")
        assert image.info["Source"] == "surrogate: stand-in recording, not a robot"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["{dataset}", "--episode=7", "--save={tmp}/x.rrd"],
            "no episode 7; it has 2, counted from 0",
        ),
        (
            ["{recording}", SPEC, "--episode=1", "--save={tmp}/x.rrd"],
            "no episode 1; it has 1, counted from 0",
        ),
        (["{tmp}/nothing", "--save={tmp}/x.rrd"], "nothing: no such file or folder"),
        (
            ["{tmp}/x.csv", "--save={tmp}/x.rrd"],
            "x.csv: a table, for taccorl compare; view opens recordings (.mcap",
        ),
        (["{dataset}", "--save={tmp}/x.png"], "must end in .rrd"),
        (["{dataset}", "--sheet={tmp}/no/x.png"], "mkdir -p"),
        (
            ["{dataset}", "--sheet={tmp}/theirs.png"],
            "exists and was not written by `taccorl view`",
        ),
        (
            ["{dataset}", "--save={tmp}/theirs.rrd"],
            "exists and was not written by `taccorl view`",
        ),
        (["{dataset}", "--start_s=60", "--save={tmp}/x.rrd"], "no rows from 60"),
        (["{dataset}"], "use --serve=true"),
        (
            ["{dataset}", "--align=contact", "--save={tmp}/x.rrd"],
            "--align has no effect without --against=",
        ),
        (
            ["{dataset}", "--against={dataset}", "--align=touch", "--save={tmp}/x.rrd"],
            "align=touch: known: contact",
        ),
        (
            ["{dataset}", "--against={dataset}", "--sheet={tmp}/x.png"],
            "--sheet shows one episode",
        ),
        (
            [
                "{dataset}",
                "--against={dataset}",
                "--against_episode=7",
                "--save={tmp}/x.rrd",
            ],
            "no episode 7; it has 2",
        ),
    ],
)
def test_what_cannot_be_done_says_why_and_what_to_do(
    words, message, dataset, recording, tmp_path, capsys, monkeypatch
):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    Image.new("RGB", (4, 4)).save(tmp_path / "theirs.png")
    (tmp_path / "theirs.rrd").write_bytes(b"RRF2 of somebody else")
    (tmp_path / "x.csv").write_text("t,elbow.q\n")
    before = {p: p.read_bytes() for p in tmp_path.iterdir()}
    filled = [
        w.format(dataset=dataset, recording=recording, tmp=tmp_path) for w in words
    ]
    assert main(["view", *filled]) == 2
    error = capsys.readouterr().err
    assert error.startswith("taccorl view: ")
    assert message in error
    assert len(error.splitlines()) == 1
    assert {p: p.read_bytes() for p in tmp_path.iterdir()} == before


@pytest.mark.parametrize("option", ["save=x.rrd", "sheet=x.png"])
@pytest.mark.parametrize("is_there", [False, True])
def test_on_a_full_disk_one_line_says_so_and_an_earlier_file_is_kept(
    option: str, is_there: bool, dataset: Path, tmp_path: Path, capfd, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    out, limits = (
        Path(option.partition("=")[2]),
        resource.getrlimit(resource.RLIMIT_FSIZE),
    )
    if is_there:
        assert main(["view", str(dataset), f"--{option}"]) == 0
        assert out.stat().st_size > 20_000  # so the limit below falls in the middle
    before = {p: p.read_bytes() for p in tmp_path.iterdir()}
    capfd.readouterr()
    resource.setrlimit(
        resource.RLIMIT_FSIZE, (20_000, limits[1])
    )  # the kernel refuses to write more, as when full
    try:
        assert main(["view", str(dataset), f"--{option}"]) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    said, error = capfd.readouterr()  # of the whole process: Rerun's own log, too
    assert "wrote" not in said
    kept = "; the earlier file is as it was" if is_there else ""
    assert (
        error
        == f"taccorl view: {out}: not written: File too large{kept}. Make room, or give another place\n"
    )
    assert {p: p.read_bytes() for p in tmp_path.iterdir()} == before


def test_printed_commands_can_be_pasted_whatever_the_path(
    dataset: Path, tmp_path: Path, capsys
):
    folder = tmp_path / "Anna's données"
    assert main(["view", str(dataset), f"--save={folder}/x y.rrd"]) == 2
    assert shlex.split(capsys.readouterr().err.partition("make it first: ")[2]) == [
        "mkdir",
        "-p",
        str(folder),
    ]
    folder.mkdir()
    assert main(["view", str(dataset), f"--save={folder}/x y.rrd"]) == 0
    program, path = shlex.split(
        capsys.readouterr().out.partition("look at it with ")[2]
    )
    assert Path(program).name == "rerun"
    assert Path(path).read_bytes().startswith(b"RRF2")


@pytest.mark.slow
@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_serve_answers_this_machine_only_and_ends_cleanly(
    dataset: Path, number: signal.Signals
):
    command = [
        sys.executable,
        "-m",
        "taccorl.cli.main",
        "view",
        str(dataset),
        "--serve=true",
    ]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2]
    )
    try:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        port = urlparse(address).port
        assert address.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(address, timeout=20) as page:
            assert page.status == 200
        for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
            local, state = line.split()[1], line.split()[3]
            if state == "0A" and int(local.split(":")[1], 16) == port:
                assert local.startswith("0100007F"), "listens on more than 127.0.0.1"
        os.kill(process.pid, number)
        assert process.wait(timeout=20) == 0
    finally:
        process.kill()
        process.wait()
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", port), timeout=2)
