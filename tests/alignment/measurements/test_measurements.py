"""Folders of measurements, what is said of them, and how they are divided."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from made_rows import of_signal
from made_sweep import sweep

from taccorl.alignment.measurements.folder import motions, read_measurements, split
from taccorl.alignment.measurements.measurement import Measurement, other_arm
from taccorl.errors import RecordingError, SpecError, TaccorlError
from taccorl.robots import ROBOT


def made(*names: str, **repeats: str) -> list[Measurement]:
    time_s, zeros = np.arange(4) / 200, np.zeros((4, 14))
    own = {n: zeros + 0.001 * k for k, n in enumerate(names)}
    return [
        Measurement(
            name=n,
            time_s=time_s,
            target=zeros,
            measured=own[n],
            repeat_of=repeats.get(n),
        )
        for n in names
    ]


def names(measurements) -> list[str]:
    return [m.name for m in measurements]


def of_one(words: str) -> str:
    """Text of a measurements.yaml with the facts ``words`` about sweep_1.csv."""
    return f"recordings: {{sweep_1.csv: {{{words}}}}}"


def pressed(words: str) -> str:
    return of_one(f"pressed: {{{words}}}")


BALL = "shape: sphere, radius_m: 0.012, arm: left"


TABLE = "t,left_joint5.q,left_joint5.q_target,left_joint5.tau\n" + "".join(
    f"{k / 200},0.1,0.2,4\n" for k in range(5)
)


@pytest.fixture
def folder(tmp_path):
    for k in (1, 2, 10, 3):
        (tmp_path / f"sweep_{k}.csv").write_text(
            TABLE.replace(",0.1,", f",{0.1 + 0.001 * k},")
        )
    (tmp_path / "notes.txt").write_text("hello")
    return tmp_path


def test_a_folder_is_read_in_natural_order_and_says_what_it_left(folder):
    found = read_measurements(folder)
    assert names(found.fit) == [
        "sweep_1.csv",
        "sweep_2.csv",
        "sweep_3.csv",
        "sweep_10.csv",
    ]
    assert found.validation == found.test == ()
    assert found.rule == "all for fitting"


def test_every_third_motion_is_validation_and_the_record_says_so(folder):
    found = read_measurements(folder, validation_every=3)
    assert names(found.validation) == ["sweep_3.csv"]
    record = found.record()
    assert record["rule"] == "every 3. of 4 motions for validation"
    assert record["fit"] == ["sweep_1.csv", "sweep_2.csv", "sweep_10.csv"]


def test_a_copy_of_a_fit_recording_checks_nothing(folder):
    (folder / "last.csv").write_text((folder / "sweep_2.csv").read_text())
    index = folder / "measurements.yaml"
    index.write_text("recordings: {last.csv: {use: test}}")
    with pytest.raises(
        TaccorlError,
        match=r"sweep_2\.csv \(fit\) is last\.csv \(test\), number for number.*remove one",
    ):
        read_measurements(folder)
    index.write_text(
        "recordings: {last.csv: {repeat_of: sweep_2.csv}}"
    )  # one use: a warning of the checks
    assert names(read_measurements(folder).fit)[0] == "last.csv"


def test_an_index_says_what_files_cannot(folder):
    (folder / "measurements.yaml").write_text(
        "recordings:\n"
        "  sweep_2.csv: {repeat_of: sweep_1.csv}\n"
        "  sweep_3.csv: {use: validation, kp: {left_joint5: 40}, payload_kg: {left: 0.5}, effort_scale: {left_joint5: 0.25},\n"
        "    payload_position_m: {left: [0.01, 0, 0.2]}}\n"
        "  sweep_10.csv: {use: test}\n"
    )
    found = read_measurements(folder)
    assert names(found.fit) == ["sweep_1.csv", "sweep_2.csv"]
    assert (names(found.validation), names(found.test)) == (
        ["sweep_3.csv"],
        ["sweep_10.csv"],
    )
    assert found.fit[1].repeat_of == "sweep_1.csv" and not found.fit[0].held
    assert found.unlisted == ("sweep_1.csv",)
    (held,) = found.validation
    assert (held.kp, held.payload_kg) == ({"left_joint5": 40.0}, {"left": 0.5})
    assert held.payload_position_m == {"left": (0.01, 0.0, 0.2)}
    np.testing.assert_array_equal(held.effort[:, 0], 1.0)
    (alone,) = read_measurements(folder / "sweep_3.csv").fit  # asked for by itself
    assert alone.kp == {"left_joint5": 40.0}
    (folder / "measurements.yaml").write_text(
        "recordings: {sweep_1.csv: {effort_scale: {left_joint5: 0}}}"
    )
    (first,) = (m for m in read_measurements(folder).all if m.name == "sweep_1.csv")
    assert np.isnan(first.effort).all()  # not measured


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("recordings: {sweep_4.csv: {use: fit}}", TaccorlError, "recording 'sweep_4.csv'.*did you mean"),
        ("recordings: {sweep_1.csv: {repeat_of: sweep_99.csv}}", TaccorlError, "repeat_of:.*recording 'sweep_99.csv'"),
        ("recordings: {sweep_1.csv: {use: validate}}", SpecError, "did you mean 'validation'"),
        ("recordings: {sweep_1.csv: {kp: {left_joint9: 3}}}", TaccorlError, "kp: no signal 'left_joint9'"),
        ("recordings: {sweep_1.csv: {kp: {left_joint5: -3}}}", SpecError, "measurements.yaml:1: .*-3 is below 0"),
        ("recordings: {sweep_1.csv: {payload_kg: {middle: 1}}}", SpecError, "no arm 'middle'"),
        (of_one("payload_kg: {left: 1}, payload_position_m: {middle: [0, 0, 0.1]}"), SpecError, "no arm 'middle'"),
        (of_one("payload_kg: {left: 1}, payload_position_m: {left: [0, 0, 168]}"), SpecError, "is it in millimetres"),
        (of_one("payload_position_m: {left: [0, 0, 0.1]}"), TaccorlError, "holds no payload"),
        ("columns: none.yaml", SpecError, "no file 'none.yaml' beside it"),
        (pressed(BALL.replace("sphere", "spere")), SpecError, r"yaml:1: .*pressed → shape: .*did you mean 'sphere'"),
        (pressed(BALL.replace("left", "lft")), SpecError, "pressed → arm: .*did you mean 'left'"),
        (pressed(BALL.replace("_m", "")), SpecError, "unknown key 'radius'; did you mean 'radius_m'"),
        (pressed("shape: sphere, radius_m: 0.012"), SpecError, "key 'arm' is missing"),
        (pressed("shape: sphere, radius_m: 12, arm: left"), SpecError, "12 m does not fit between .*millimetres"),
        (pressed("shape: sphere, radius_m: 0, arm: left"), SpecError, "radius_m: 0 is not above 0"),
        (pressed("shape: rod, radius_m: 0.008, arm: left"), SpecError, "a rod needs its length_m"),
        (pressed(f"{BALL}, length_m: 0.1"), SpecError, "a sphere has no length_m"),
        (pressed(f"{BALL}, position_m: [0, 0]"), SpecError, "expected 3 values, found 2"),
        (pressed(f"{BALL}, frame: hand"), SpecError, "'hand' is not one of 'tcp', 'world'"),
        (pressed(BALL), TaccorlError, "yaml: recordings → sweep_1.csv → pressed:.*recording holds.*frames.*pads; record"),
    ],
)  # fmt: skip
def test_a_wrong_index_is_named(folder, text, error, message):
    (folder / "measurements.yaml").write_text(text + "\n")
    with pytest.raises(error, match=message):
        read_measurements(folder)


def test_the_index_names_the_columns_file(tmp_path):
    (tmp_path / "a.csv").write_text("ms,q,u\n0,0,90\n5,0,90\n")
    (tmp_path / "columns.yaml").write_text(
        "time: {column: ms, unit: ms}\nsignals: {left_joint1: {q: {column: q, unit: deg}, q_target: {column: u, unit: deg}}}\n"
    )
    (tmp_path / "measurements.yaml").write_text("columns: columns.yaml\n")
    assert read_measurements(tmp_path).fit[0].target[0, 0] == pytest.approx(np.pi / 2)


def test_nothing_to_read_is_an_error_with_a_way_out(tmp_path):
    with pytest.raises(RecordingError, match="no such file or folder"):
        read_measurements(tmp_path / "sweps")
    with pytest.raises(
        RecordingError, match=r"no recording here.*tables \(.csv, .parquet, .mat\)"
    ):
        read_measurements(tmp_path)


def test_split_is_deterministic_and_complete():
    found = [split(made(*"abcdefg"), validation_every=2) for _ in range(2)]
    assert found[0].record() == found[1].record()
    assert names(found[0].validation) == ["b", "d", "f"]
    assert sorted(names(found[0].all)) == list("abcdefg")


def test_a_motion_and_its_repeats_stay_together():
    measurements = made(*"abcd", b="a", d="c")
    assert motions(measurements) == {"a": "a", "b": "a", "c": "c", "d": "c"}
    found = split(measurements, validation_every=2)
    assert (names(found.fit), names(found.validation)) == (["a", "b"], ["c", "d"])
    assert names(split(measurements, validation=["d"]).validation) == ["c", "d"]
    said = r"d \(test\) and c \(validation\) repeat one motion|c \(validation\) and d \(test\)"
    with pytest.raises(TaccorlError, match=said):
        split(measurements, validation=["c"], test=["d"])


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"validation": ["z"]}, "validation: no measurement 'z'"),
        ({"validation": ["a"], "test": ["a"]}, "both.*validation.*test"),
        (
            {"validation": ["a", "b"]},
            r"left.*fit:.*b.*2.*validation.*measurements\.yaml",
        ),
        ({"validation_every": 1}, "leaves nothing.*fit"),
    ],
)
def test_splits_that_cannot_be(kwargs, message):
    with pytest.raises(TaccorlError, match=message):
        split(made("a", "b"), **kwargs)


def test_repeats_in_a_circle():
    with pytest.raises(TaccorlError, match="a repeats b repeats a: a circle"):
        motions(made("a", "b", a="b", b="a"))
    with pytest.raises(TaccorlError, match=r"two measurements.*'a'"):
        split(made("a", "a"))


def test_shapes_and_units_are_checked():
    (m,) = made("a")
    with pytest.raises(
        TaccorlError, match=r"measured.*\(3, 14\),.*times.*signals.*\(4, 14\)"
    ):
        dataclasses.replace(m, measured=np.zeros((3, 14)))
    with pytest.raises(TaccorlError, match="rad or m, not 'deg'"):
        dataclasses.replace(m, units=("deg",) * 14)
    with pytest.raises(TaccorlError, match="did you mean 'left_joint5'"):
        m.column("left_joint_5")
    assert np.isnan(m.effort).all() and m.has_effort().sum() == 0
    assert m.rate_hz == 200.0


def test_resampling_keeps_the_mean_time_of_everything():
    # 200 Hz to 100 Hz of a ramp and a step: the ramp is exact, the step's middle stays where it was.
    m = sweep(0, seconds=1.0, noise_rad=0.0)
    ramp = np.arange(m.num_rows)[:, None] * np.ones(14)
    half = dataclasses.replace(m, target=ramp).resampled(100.0)
    np.testing.assert_allclose(half.target[:, 0], np.arange(half.num_rows) * 2)
    same = m.resampled(200.0)
    np.testing.assert_allclose(same.measured, m.measured, atol=1e-12)
    back = dataclasses.replace(m, time_s=m.time_s[::-1])
    with pytest.raises(TaccorlError, match="time does not increase"):
        back.resampled(100.0)


def test_a_recording_of_one_joint_becomes_one_of_the_robot():
    m = of_signal("one", 200.0, np.full(3, 0.2), np.full(3, 0.1), "left_joint5")
    rest = np.arange(14.0)
    whole = m.on_robot(rest)
    assert whole.signals == ROBOT.action_names
    np.testing.assert_array_equal(
        whole.target[0], np.where(np.arange(14) == 4, 0.2, rest)
    )
    assert np.isfinite(whole.measured).sum() == 3
    wrong = dataclasses.replace(m, units=("m",))
    with pytest.raises(
        TaccorlError, match="left_joint5 is in m, the robot's is in rad"
    ):
        wrong.on_robot(rest)
    assert [other_arm(n) for n in ("left_joint5", "right_gripper", "drive")] == [
        "right_joint5",
        "left_gripper",
        "drive",
    ]


@pytest.mark.parametrize(
    ("last", "note", "held"),
    [(0.31, "", True), (0.31, "a.csv", False), (0.3, "a.csv", True)],
)
def test_torques_are_held_where_nothing_repeats(
    tmp_path: Path, last: float, note: str, held: bool
) -> None:
    """A copy repeats nothing."""
    for name, q in (("a.csv", 0.3), ("b.csv", last)):
        (tmp_path / name).write_text(
            f"t,servo.q,servo.tau_target\n0.0,0.1,0.0\n0.1,0.2,0.5\n0.2,{q},0.0\n"
        )
    (tmp_path / "measurements.yaml").write_text(
        f"recordings: {{b.csv: {{repeat_of: {note or 'null'}}}}}"
    )
    assert [
        m.held for m in read_measurements(tmp_path, units={"servo": "rad"}).all
    ] == [held] * 2
