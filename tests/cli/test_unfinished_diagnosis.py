"""What a diagnosis has found is in its report however it ends: SIGTERM, Ctrl-C, a fault, a worker that is killed."""

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest

from taccorl.cli.progress import Steps
from taccorl.diagnosis.machines.load import load_machine
from taccorl.diagnosis.search.problem import Found
from taccorl.report.interim import Interim
from taccorl.sim.effects import effects, make_effect
from tests.cli.simulated_loop import robot

CONSIDERED = ("coulomb_friction", "viscous_friction", "command_delay")
FEW = f"--without=[{','.join(name for name in effects if name not in CONSIDERED)}]"
WORDS = ("diagnose", "bench", "--twin=machine.yaml", "--out=found", FEW)


@pytest.fixture
def bench(tmp_path: Path) -> Path:
    (tmp_path / "bench").mkdir()
    robot(tmp_path)
    (tmp_path / "bench" / "measurements.yaml").write_text(
        "recordings:\n  held.csv: {use: validation}\n"
    )
    return tmp_path


def added(report: dict[str, Any], part: str) -> list[str]:
    return [e["effect"] for e in report["diagnoses"][part]["effects"]]


def test_each_accepted_effect_and_each_part_is_in_a_report_that_add_effect_reads(
    bench: Path, said: Any
) -> None:
    """0.15 N·m were found at the first joint, nothing yet at the second one."""
    machine = load_machine(Path("machine.yaml"))
    friction = make_effect("coulomb_friction", torque_nm=0.15)
    facts: dict[str, Any] = {"present": (), "base": {"torque_ff": 0.01}}
    facts |= {"errors": {"after": {"fit": 1.0, "validation": 2.0}}, "intervals": {}}
    interim = Interim(
        folder=Path("found"),
        kept=Path("kept"),
        title="made",
        provenance={"twin, SHA-256": machine.digest()},
    )
    first = Found("accepted", effects=[friction], finished=False, **facts)
    interim.add("swing", first)
    interim.add("other/joint", Found("finished", effects=[], finished=True, **facts))
    assert interim.parts == ["other/joint", "swing"]
    report = json.loads(Path("found/report.json").read_text())
    assert report["finished"] is False
    assert (added(report, "swing"), added(report, "other/joint")) == (
        ["coulomb_friction"],
        [],
    )
    assert report["diagnoses"]["other/joint"]["finished"] is True
    page = Path("found/report.html").read_text()
    assert "not finished" in page and "coulomb_friction" in page
    del report["diagnoses"]["other/joint"]  # which this machine does not have
    Path("found/report.json").write_text(json.dumps(report))
    words = ("--twin=machine.yaml", "--diagnosis=found", "--out=added.yaml")
    code, text = said("add-effect", "coulomb_friction", *words)
    assert code == 0 and "not finished" in text
    (effect,) = load_machine(Path("added.yaml")).robot.config.joints["swing"].effects  # type: ignore[attr-defined]
    assert effect.torque_nm == 0.15


class Fault(Exception):
    """Any fault of the program."""


def at(monkeypatch: pytest.MonkeyPatch, begins: str, does: Any) -> None:
    """Call ``does`` once, at the first step of the search whose text contains ``begins``."""
    plain, done = Steps.__call__, list[str]()

    def step(self: Steps, part: str, text: str = "") -> None:
        if begins in text and not isinstance(text, Found) and not done:
            done.append(text)
            does()
        plain(self, part, text)

    monkeypatch.setattr(Steps, "__call__", step)


def ended(number: int) -> Any:
    return lambda: os.kill(os.getpid(), number)


@pytest.mark.slow
@pytest.mark.parametrize("step", ["coulomb_friction, validation", "last refit"])
@pytest.mark.parametrize(
    ("number", "codes"), [(signal.SIGTERM, (143,)), (signal.SIGINT, (0, 1))]
)
def test_a_signal_ends_with_a_report_of_what_was_found(
    number: int,
    codes: tuple[int, ...],
    step: str,
    bench: Path,
    said: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """While the second effect is sought, and in the last refit, after which nothing more is tried."""
    before = signal.getsignal(number)
    at(monkeypatch, step, ended(number))
    code, text = said(*WORDS, "--until=noise_floor")
    assert code in codes and signal.getsignal(number) is before, text
    report = json.loads(Path("found/report.json").read_text())
    assert "coulomb_friction" in added(report, "swing")
    assert report["finished"] is False
    assert "not finished" in Path("found/report.html").read_text()
    (d,) = report["diagnoses"].values()
    assert d["intervals"] and Path("found/machine.yaml").exists()


@pytest.mark.slow
def test_a_fault_after_an_effect_was_accepted_leaves_the_report(
    bench: Path, said: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails() -> None:
        raise Fault

    at(monkeypatch, "coulomb_friction, validation error", fails)
    with pytest.raises(Fault):
        said(*WORDS, "--until=noise_floor")
    report = json.loads(Path("found/report.json").read_text())
    assert report["finished"] is False
    assert added(report, "swing") == ["coulomb_friction"]
    words = ("--twin=machine.yaml", "--diagnosis=found", "--out=added.yaml")
    assert said("add-effect", "coulomb_friction", *words)[0] == 0


@pytest.mark.slow
def test_sigterm_before_an_effect_was_found_writes_nothing(
    bench: Path, said: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    at(monkeypatch, "no effect added", ended(signal.SIGTERM))
    code, text = said(*WORDS)
    assert code == 143
    assert "no report was written" in text
    assert not Path("found").exists()
