"""A surrogate robot as files: what is read back is what was made, and nobody reads the truth by the way."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from taccorl.alignment.measurements.folder import read_measurements
from taccorl.cli.main import main
from taccorl.errors import TaccorlError
from taccorl.sim.twin_file import load_twin
from taccorl.surrogate import recordings as module
from taccorl.surrogate.cases import draw_case
from taccorl.surrogate.recordings import recordings
from taccorl.surrogate.writing import SWEEPS, TRUTH, TWIN, reveal, write_recordings

pytestmark = pytest.mark.slow
OPENED: list[str] = []


def _note(event: str, args: tuple) -> None:
    if event == "open" and isinstance(args[0], str):
        OPENED.append(args[0])


sys.addaudithook(_note)


@pytest.fixture(scope="module", autouse=True)
def few_motions():
    """Four recordings instead of eight: which motions there are is tested in test_recordings.py."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "VALIDATION", module.VALIDATION[:1])
        patch.setattr(module, "TEST", module.TEST[1:])
        yield


@pytest.fixture(scope="module")
def case():
    return draw_case(
        ["coulomb_friction"], 7, signal="left_joint4", design="chirp", strength=8.0
    )


@pytest.fixture(scope="module")
def folder(case, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("robot") / "made"
    write_recordings([case], folder)
    return folder


@pytest.fixture(scope="module")
def read(folder):
    return read_measurements(folder / SWEEPS)


def test_what_is_read_back_is_what_was_recorded(case, read):
    made = recordings(case)
    assert [m.name.removesuffix(".mcap")[3:] for m in read.all] == [
        m.name for m in made.all
    ]
    assert [len(getattr(read, use)) for use in ("fit", "validation", "test")] == [
        len(part) for part in (made.fit, made.validation, made.test)
    ]
    assert not read.skipped
    for one, back in zip(made.all, read.all, strict=True):
        rows = one.num_rows - back.num_rows
        assert 0 <= rows <= 10  # until the first command is seen
        same = (
            np.abs(one.target[rows:] - back.target) < 1e-6
        )  # piper_ros' factor of 0.017444 is undone to 1e-7
        assert (
            same.mean() > 0.97
        )  # drivers repeat one message in fifty, and the reader draws a line there
        moved = np.abs(one.measured[rows:] - back.measured)[:, :6]
        assert np.median(moved) < 1e-6 and (moved < 2e-3).all()
        assert np.median(np.abs(one.effort[rows:] - back.effort)) < 1e-9
        assert (
            back.origin == one.origin
            and back.origin.domain == "surrogate"
            and "not a robot" in back.origin.text
        )
        assert (back.kp, back.gain_scale, back.payload_kg) == (
            one.kp,
            one.gain_scale,
            one.payload_kg,
        )
    assert read.fit[1].repeat_of == read.fit[0].name


def test_the_twin_is_the_one_the_user_starts_from(case, folder):
    assert load_twin(folder / TWIN) == case.twin


def test_the_truth_is_sealed_and_can_be_revealed(case, folder, capsys):
    text = (folder / TRUTH).read_text()
    assert "coulomb" not in text and "torque_nm" not in text
    assert reveal(folder)["hidden"] == json.loads(json.dumps(case.truth()))["hidden"]
    assert main(["surrogate", f"--reveal={folder}"]) == 0
    assert (
        json.loads(capsys.readouterr().out)["hidden"][0]["name"] == "coulomb_friction"
    )


def test_nothing_that_reads_measurements_opens_the_truth(folder):
    OPENED.clear()
    read_measurements(folder / SWEEPS)
    main(["compare", f"--twin={folder / TWIN}", f"--measurements={folder / SWEEPS}"])
    assert any(path.endswith(".mcap") for path in OPENED)
    assert not any(TRUTH in path for path in OPENED)
    for line in (folder / SWEEPS).rglob("*"):
        assert line.suffix in (".mcap", ".yaml")
        assert b"coulomb" not in line.read_bytes()


def test_a_second_robot_replaces_the_first_and_nothing_else(case, folder, tmp_path):
    other = tmp_path / "mine"
    other.mkdir()
    (other / "thesis.txt").write_text("important")
    with pytest.raises(TaccorlError, match="surrogate robot"):
        write_recordings([case], other)
    assert (other / "thesis.txt").read_text() == "important"
    with pytest.raises(TaccorlError, match="no such file"):
        reveal(other)


def test_the_command_line_says_what_is_missing(capsys):
    assert main(["surrogate"]) == 2 and "--secret=" in capsys.readouterr().err
    assert main(["surrogate", "--secret=1", "--effects=[nothing_of_the_sort]"]) == 2
    assert "no hidden effect" in capsys.readouterr().err
