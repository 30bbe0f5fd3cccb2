"""Surrogate pads as files: frames, stamps and what was pressed are read back as they were made, and nobody reads the truth."""

import errno
import json
import os
from pathlib import Path

import numpy as np
import pytest
import yaml

from taccorl.alignment.measurements.folder import INDEX, Measurements, read_measurements
from taccorl.cli.main import main
from taccorl.cli.measured import checked
from taccorl.diagnosis.machines.piper import PiperTwin
from taccorl.errors import SpecError, TaccorlError
from taccorl.sim.twin_file import load_twin
from taccorl.surrogate import touch, writing
from taccorl.surrogate.drivers import START_UNIX_NS
from taccorl.surrogate.touch import TouchCase, draw_touch_case
from taccorl.surrogate.touch_hidden import REGISTERED_TOUCH, TOUCH_KINDS
from taccorl.surrogate.writing import (
    PRESSES,
    TRUTH,
    TWIN,
    draw_touch_secret,
    reveal,
    write_touch_recordings,
)

KNOTS = (
    (0.0, -1e-3),
    (2.0, -1e-3),
    (2.3, 8e-4),
    (3.0, 8e-4),
    (3.3, -1e-3),
    (4.5, -1e-3),
)
BALL = touch.Press(name="ball", knots=KNOTS, x_m=0.001, z_m=0.003)
AGAIN = touch.Press(name="again", knots=KNOTS, x_m=0.001, z_m=0.003, repeat_of="ball")
SIZES = ("radius_m", "half_height_m")
ROD = touch.Press(name="rod", knots=KNOTS, shape="rod", x_m=0.0, z_m=0.012)


@pytest.fixture(scope="module")
def case() -> TouchCase:
    return draw_touch_case(["taxel_saturation"], 5, arm="right", strength=8.0)


@pytest.fixture(scope="module")
def written(
    case: TouchCase, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Measurements]:
    """Three short presses instead of seven long ones."""
    folder = tmp_path_factory.mktemp("pads") / "made"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            touch, "_USES", {"fit": (BALL, AGAIN), "validation": (ROD,), "test": ()}
        )
        return folder, write_touch_recordings(case, folder)


@pytest.fixture(scope="module")
def read(written: tuple[Path, Measurements]) -> Measurements:
    return read_measurements(written[0] / PRESSES)


def test_frames_and_stamps_are_read_back_as_they_were_made(written, read):
    made = written[1]
    assert [m.name for m in read.fit] == [
        "01_ball.mcap",
        "02_again.mcap",
    ] and read.validation[0].name == "03_rod.mcap"
    for one, back in zip((*made.fit, *made.validation), read.all, strict=True):
        assert one.touch is not None and back.touch is not None
        sent, told = (t.counts + t.baseline for t in (one.touch, back.touch))
        np.testing.assert_array_equal(told, sent)  # every byte of every board
        # The reader's baseline is the median of the first 30 frames, the maker's of 100: 1.3 counts · √(1/30 + 1/100) apart
        assert np.abs(back.touch.baseline - one.touch.baseline).max() <= 2
        begin_s = (back.start_ns - START_UNIX_NS) / 1e9
        np.testing.assert_allclose(
            back.touch.time_s + begin_s, one.touch.time_s, atol=2e-9
        )
        gripper = one.measured[8:, 13]
        np.testing.assert_allclose(
            np.interp(one.time_s[8:] - begin_s, back.time_s, back.measured[:, 13]),
            gripper,
            atol=3e-5,
        )
        assert (
            back.origin == one.origin
            and back.origin.domain == "surrogate"
            and "not a robot" in back.origin.text
        )
    assert read.fit[1].repeat_of == read.fit[0].name


def test_what_was_pressed_is_read_back(case, read):
    for m, press in zip(read.all, (BALL, AGAIN, ROD), strict=True):
        meant = press.pressed(case.arm).made()
        assert m.pressed is not None and (m.pressed.arm, m.pressed.frame) == (
            "right",
            "tcp",
        )
        np.testing.assert_allclose(m.pressed.pose, meant.pose, atol=1e-12)
        (solid,), (true,) = m.pressed.solids, meant.solids
        assert type(solid) is type(true)
        assert [getattr(solid, k) for k in SIZES] == [getattr(true, k) for k in SIZES]


def test_nothing_is_wrong_with_the_recordings(read):
    found = checked(PiperTwin.nominal(), read)
    assert [f for own in found.values() for f in own if f.severity != "note"] == []


def test_the_truth_is_sealed_and_the_twin_is_the_one_to_start_from(case, written):
    folder = written[0]
    assert load_twin(folder / TWIN) == case.twin and reveal(folder) == json.loads(
        json.dumps(case.truth())
    )
    for path in (folder / TRUTH, folder / TWIN, *(folder / PRESSES).iterdir()):
        assert b"saturation" not in path.read_bytes()


def test_a_repeat_with_something_else_pressed_is_refused(written, tmp_path):
    for path in (written[0] / PRESSES).glob("0[12]*.mcap"):
        (tmp_path / path.name).symlink_to(path)
    index = yaml.safe_load((written[0] / PRESSES / INDEX).read_text())
    del index["recordings"]["03_rod.mcap"]
    index["recordings"]["02_again.mcap"]["pressed"]["radius_m"] = 0.013
    (tmp_path / INDEX).write_text(yaml.safe_dump(index))
    said = r"02_again.mcap → pressed: this recording repeats 01_ball.mcap, .*correct pressed, or repeat_of"
    with pytest.raises(TaccorlError, match=said):
        read_measurements(tmp_path)
    index["recordings"]["02_again.mcap"]["pressed"]["radius_m"] = "0.012"
    (tmp_path / INDEX).write_text(yaml.safe_dump(index))
    said = r"measurements.yaml:\d+: recordings → 02_again.mcap → pressed → radius_m: expected float"
    with pytest.raises(SpecError, match=said):
        read_measurements(tmp_path)


def test_a_secret_hides_what_pads_can_hide():
    drawn = [draw_touch_secret(seed) for seed in range(200)]
    names = {name for names in drawn for name in names}
    assert names <= set(TOUCH_KINDS) and len(names & set(REGISTERED_TOUCH)) == len(
        REGISTERED_TOUCH
    )
    assert 0.04 < drawn.count(()) / 200 < 0.18
    assert draw_touch_secret(3) == draw_touch_secret(3)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--signal=left_joint5"],
            "--signal applies to joints only; remove it with --pads=left",
        ),
        (["--effects=[taxel_crep]"], "no hidden effect 'taxel_crep'"),
        (["--pads=both"], "both"),
    ],
)
def test_the_command_line_says_what_is_wrong(words, message, capsys, tmp_path):
    assert (
        main(
            [
                "surrogate",
                "--secret=1",
                "--pads=left",
                f"--out={tmp_path / 'x'}",
                *words,
            ]
        )
        == 2
    )
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "x").exists()


def test_a_disk_that_is_full_leaves_nothing_half_written_and_what_was_there(
    tmp_path, monkeypatch
):
    case = draw_touch_case((), 3, arm="left")
    monkeypatch.setattr(touch, "_USES", {"fit": (BALL,), "validation": (), "test": ()})
    folder = tmp_path / "robot"
    write_touch_recordings(case, folder)
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(writing, "save_twin", full)
    with pytest.raises(
        TaccorlError,
        match=r"robot: No space left on device; nothing was written or replaced.*--out=",
    ):
        write_touch_recordings(draw_touch_case((), 4, arm="left"), folder)
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before
    assert [p.name for p in tmp_path.iterdir()] == ["robot"]
