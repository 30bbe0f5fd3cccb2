"""Command lines into configs: what is typed is what is meant, and a slip is named."""

from dataclasses import dataclass, field
from pathlib import Path

import draccus
import pytest

from taccorl.cli.collect import CollectConfig
from taccorl.cli.parse import given_names, parse
from taccorl.errors import TaccorlError


@dataclass(frozen=True, kw_only=True)
class Coil:
    """In a motor."""

    turns: int = 100


@dataclass(frozen=True, kw_only=True)
class Motor(draccus.ChoiceRegistry):
    """Something that turns."""


@Motor.register_subclass("small")
@dataclass(frozen=True, kw_only=True)
class SmallMotor(Motor):
    """The default."""

    poles: int = 2
    coil: Coil = field(default_factory=Coil)


@Motor.register_subclass("big")
@dataclass(frozen=True, kw_only=True)
class BigMotor(Motor):
    """Needs a voltage."""

    voltage_v: float


@dataclass(kw_only=True)
class Robot:
    """For these tests."""

    paths: list[Path]
    """Files."""
    name: str
    """Its name."""
    home: Path | None = None
    """Its home."""
    joints: int = 6
    """How many."""
    reach_m: float | None = None
    """How far."""
    quick: bool = False
    """Or not."""
    seeds: list[int] = field(default_factory=list)
    """Which ones."""
    motor: Motor = field(default_factory=SmallMotor)
    """Which one."""
    gains: dict[str, float] = field(default_factory=dict)


def robot(*words: str) -> Robot:
    return parse(Robot, list(words), positional="paths")


def test_bare_words_and_options_in_any_order() -> None:
    found = robot(
        "a.mcap", "--name=arm", "b.mcap", "--joints=7", "--quick=true", "--reach_m=0.8"
    )
    expected = Robot(
        paths=[Path("a.mcap"), Path("b.mcap")],
        name="arm",
        joints=7,
        quick=True,
        reach_m=0.8,
    )
    assert found == expected


@pytest.mark.parametrize(
    "odd",
    [
        "run #3.mcap", "123", "1e3", "true", "null", "~", "2024-01-01", "a: b", "[x]y", "{a", "./- a", "it's", '"quoted"',
        "includes/x", "include", "a=b", "*.mcap", "&anchor", "!tag", "über 測試 😀", "b\udc80d", "  spaced  ", "%d", "a,b", "@x",
    ],
)  # fmt: skip
def test_paths_and_texts_are_taken_as_typed(odd: str) -> None:
    assert robot(odd, "--name=x").paths == [Path(odd)]
    if odd != "~":
        assert robot("x", f"--name={odd}").name == odd
    if odd != "null":
        assert robot("x", "--name=x", f"--home={odd}").home == Path(odd)


def test_a_value_may_follow_its_option_as_a_word() -> None:
    found = robot(
        "a.mcap",
        "--name",
        "arm",
        "--joints",
        "7",
        "b.mcap",
        "--reach_m",
        "-0.8",
        "--motor.coil.turns",
        "7",
    )
    motor = SmallMotor(coil=Coil(turns=7))
    assert found == Robot(
        paths=[Path("a.mcap"), Path("b.mcap")],
        name="arm",
        joints=7,
        reach_m=-0.8,
        motor=motor,
    )
    assert given_names(["--out", "a", "--ppo.clip", "0.2"]) == {"out", "ppo.clip"}


def test_a_list_may_be_given_by_repeating_or_as_yaml() -> None:
    assert robot("--paths=a", "--paths=b", "--name=x").paths == [Path("a"), Path("b")]
    assert robot("--paths=[a, b]", "--name=x").paths == [Path("a"), Path("b")]
    for words in ("--seeds=7", "--seeds=9"), ("--seeds=[7,9]",):
        assert robot("a", "--name=x", *words).seeds == [7, 9]
    with pytest.raises(TaccorlError, match="seeds"):
        robot("a", "--name=x", "--seeds=many")


def test_null_takes_back_an_optional_value(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("name: x\npaths: [a]\nhome: /home/me\n")
    assert robot(f"--config_path={tmp_path / 'c.yaml'}").home == Path("/home/me")
    assert robot(f"--config_path={tmp_path / 'c.yaml'}", "--home=null").home is None


def test_a_tilde_is_the_home_folder_not_a_folder_named_tilde(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("HOME", "/home/someone")
    assert robot("x", "--name=x", "--home=~/data").home == Path("/home/someone/data")


def test_options_go_before_the_config_file_which_may_have_any_name(
    tmp_path: Path,
) -> None:
    (tmp_path / "c.yaml").write_text(
        "name: from file\njoints: 5\npaths: [a]\nmotor: {type: big, voltage_v: 24}\n"
    )
    found = robot(f"--config_path={tmp_path / 'c.yaml'}", "--joints=4", "b")
    assert found == Robot(
        paths=[Path("b")], name="from file", joints=4, motor=BigMotor(voltage_v=24.0)
    )
    path = tmp_path / "run #3: ünï.yaml"
    path.write_text("name: x\npaths: [a]\n")
    assert robot(f"--config_path={path}").name == "x"


def test_a_nested_option_means_the_default_kind() -> None:
    assert robot("x", "--name=x", "--motor.poles=8").motor == SmallMotor(poles=8)
    assert robot(
        "x", "--name=x", "--motor={type: small, poles: 4}"
    ).motor == SmallMotor(poles=4)
    assert robot("x", "--name=x", "--motor.coil.turns=7").motor == SmallMotor(
        coil=Coil(turns=7)
    )
    assert robot(
        "x", "--name=x", "--motor.type=big", "--motor.voltage_v=12"
    ).motor == BigMotor(voltage_v=12.0)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("x", "--nme=a"), ("unknown option '--nme=a'", "did you mean 'name'")),
        (
            ("x", "--name=a", "-joints=3"),
            ("unknown option '-joints=3'", "did you mean 'joints'"),
        ),
        (
            ("x", "--name=a", "--motor.pole=3"),
            ("unknown option", "did you mean 'motor.poles'"),
        ),
        (
            ("x", "--name=a", "--motor.coil.turn=3"),
            ("unknown option", "did you mean 'motor.coil.turns'"),
        ),
        (("x", "--name=a", "--motor=big"), ("--motor=big", "--motor.type=big")),
        (
            ("x", "--name=a", "--motor=huge"),
            ("--motor=huge", "--motor.type=small or --motor.type=big"),
        ),
        (
            ("x", "--name=a", "--seeds=many"),
            ("--seeds=many: expected numbers, such as [0.1, 0.4]",),
        ),
        (
            ("x", "--name=a", "--gains=abc"),
            ("--gains=abc: expected names and numbers, '{name: 0.4}'",),
        ),
        (("x", "--name=a", "--motor.type=bigg"), ("'bigg'", "small", "big")),
        (("x", "--name=a", "--motor.type=big"), ("voltage_v",)),
        (("x", "--name=a", "--motor.type=big", "--motor.poles=3"), ("poles",)),
        (("x", "--name"), ("option '--name' needs a value: --name=…",)),
        (("x", "--name", "--joints=3"), ("option '--name' needs a value: --name=…",)),
        (("--quick", "x", "--name=a"), ("--quick", "'x'", "--quick=true")),
        (("x", "--name="), ("option '--name=' needs a value",)),
        (
            ("x", "--name=a", "--quick"),
            ("option '--quick' needs a value: --quick=true",),
        ),
        (
            ("--name=a",),
            ("missing --paths= (give a file or folder); --help says more",),
        ),
        (("x",), ("missing --name=",)),
        ((), ("missing --paths= (give a file or folder), --name=",)),
        (
            ("--name=a", "--paths=[a,b]", "--paths=c"),
            ("--paths=[a,b] and --paths=c", "once, or repeat"),
        ),
        (("x", "--name=a", "--joints=six"), ("--joints=six", "whole number")),
        (("x", "--name=a", "--joints=1.5"), ("joints", "1.5")),
        (("x", "--name=a", "--reach_m=half"), ("--reach_m=half", "expected a number")),
        (("x", "--name=a", "--quick=maybe"), ("quick", "'maybe'", "true or false")),
        (
            ("x", "--name=a", "--quick=1"),
            ("quick", "'1'", "true or false", "--quick=true"),
        ),
        (("x", "--name=a", "--reach_m=[1"), ("[1",)),
        (("x", "--name=a", "--paths=b"), ("'x' and --paths=…", "--paths=…")),
        (("", "--name=a"), ("paths is empty",)),
        (("--name=a", "--config_path=odd.yaml"), ("odd.yaml", "found list")),
        (("--name=a", "--config_path=bad.yaml"), ("bad.yaml", "is not YAML")),
        (("--name=a", "--config_path=typo.yaml"), ("pathz",)),
    ],
)
def test_a_slip_is_named_with_the_way_out(words, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("odd.yaml").write_text("- 1\n")
    Path("bad.yaml").write_text("paths: [a\n")
    Path("typo.yaml").write_text("pathz: [a]\n")
    with pytest.raises(TaccorlError) as error:
        robot(*words)
    for word in said:
        assert word in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("value", ["1" * 5000, "[" * 1000])
def test_an_absurd_value_is_refused_by_its_options_name(value: str) -> None:
    with pytest.raises(TaccorlError, match=r"--episodes: .*--config_path"):
        parse(CollectConfig, [f"--episodes={value}"])


def test_help_names_the_verb_then_says_what_the_module_says(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as stop:
        parse(Robot, ["x", "--help=all"], positional="paths", prog="taccorl move")
    assert stop.value.code == 0
    usage, empty, said, *rest = capsys.readouterr().out.splitlines()
    assert usage == "usage: taccorl move PATHS … --name=… [options]"
    assert (empty, said) == (
        "",
        "Command lines into configs: what is typed is what is meant, and a slip is named.",
    )
    options = " ".join(" ".join(rest).split())
    assert "Files. (required)" in options and "Its name. (required)" in options
    assert "How many. (default: 6)" in options
    assert "Its home. --joints" in options, "nothing to say about a default of nothing"
    assert "None" not in options


def test_one_word_fills_a_single_field_and_no_more() -> None:
    @dataclass(kw_only=True)
    class One:
        """For this test."""

        path: Path
        """Where."""

    assert parse(One, ["2024-01-01"], positional="path") == One(path=Path("2024-01-01"))
    with pytest.raises(TaccorlError, match="one path can be given, found a b"):
        parse(One, ["a", "b"], positional="path")
    with pytest.raises(TaccorlError, match="did not expect 'a'; options: --path="):
        parse(One, ["a"])


def test_the_command_of_a_configuration_gives_the_configuration() -> None:
    from taccorl.cli.augment import AugmentConfig
    from taccorl.cli.evaluate import EvaluateConfig, PolicyChoice
    from taccorl.cli.ingest import IngestConfig
    from taccorl.cli.merge import MergeConfig
    from taccorl.cli.parse import command, parse
    from taccorl.cli.surrogate import SurrogateConfig
    from taccorl.lineage.engines import LocalEngine

    augmented = AugmentConfig(
        source=Path("a b"), task="puzzle", images=False, engine=LocalEngine(workers=3)
    )
    assert command("augment", augmented) == [
        "taccorl", "augment", "--source=a b", "--task=puzzle", "--images=false", "--engine.workers=3",
    ]  # fmt: skip
    for config, positional in (
        (augmented, None),
        (
            IngestConfig(paths=[Path("x.mcap"), Path("y z")], spec="s", domain="real"),
            "paths",
        ),
        (
            MergeConfig(real=[Path("r")], sim=[Path("s1"), Path("s2")], out=Path("o")),
            None,
        ),
        (
            SurrogateConfig(
                secret=3, effects=["coulomb_friction"], strength=12.5, gains_known=True
            ),
            None,
        ),
        (
            EvaluateConfig(
                policy=PolicyChoice(path=Path("p")),
                task=["puzzle", "test_tube"],
                episode_length=9,
            ),
            None,
        ),
    ):
        assert (
            parse(
                type(config),
                command("x", config, positional)[2:],
                positional=positional,
            )
            == config
        )
