"""``taccorl augment`` as a user types it, on two demonstrations from the twin (simulated, not a robot)."""

import json
import shlex
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import yaml

from taccorl.cli.augment import view_commands
from taccorl.cli.main import main
from taccorl.data.dataset import Dataset
from taccorl.episodes.plan import Made
from taccorl.episodes.sources.mimicgen.augment import AugmentPlan, attempt_episode
from taccorl.episodes.sources.mimicgen.spec import mimic_spec_path
from taccorl.lineage.stage import Artefact

WORDS = (
    "--task=assembly_2",
    "--episodes=1",
    "--images=false",
    "--out=new",
    "--store=store",
)


@pytest.fixture(scope="module")
def place(collected: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the command was run once."""
    folder = tmp_path_factory.mktemp("augment_cli")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main(["augment", f"--source={collected}", *WORDS]) == 0
    return folder


def report(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "new/meta/taccorl/collect_report.json").read_text())


def test_the_result_keeps_yield_causes_and_grips(place):
    told, dataset = report(place), Dataset(place / "new")
    assert dataset.num_episodes == told["episodes"] == told["outcomes"]["success"] == 1
    assert [entry["attempt"] for entry in told["entries"]] == list(
        range(told["attempts"])
    )
    assert sum(told["outcomes"].values()) == told["attempts"]
    grips = [(g["arm"], g["part"], g["sources"]) for g in told["grips"]["hands"]]
    assert (
        grips == [("left", "cradle", 2), ("right", "plug", 2)] and told["grips"]["few"]
    )
    assert all(1 <= g["different"] <= 2 for g in told["grips"]["hands"])
    card = (place / "new/README.md").read_text()
    assert (
        "**Data: twin: MuJoCo twin, not a robot**" in card
        and f"{told['attempts']} attempt" in card
    )


def test_the_same_command_again_makes_nothing_anew(collected, place, said):
    attempts = sorted((place / "store" / "mimicgen").iterdir())
    code, text = said("augment", f"--source={collected}", *WORDS)
    assert code == 0 and f"yield:   1 of {len(attempts)}" in text
    assert (
        "warning: fewer than 50 different grips" in text
        and "taccorl collect --task=assembly_2 --episodes=3500" in text
    )
    assert "next:    taccorl view new --episode=0" in text
    assert sorted((place / "store" / "mimicgen").iterdir()) == attempts


def test_of_each_cause_the_first_attempt_with_actions_can_be_viewed():
    """A failed attempt is opened by its stored physics, which a failed second execution has too; without it by its result."""
    ended = [
        ("dropped", 0),
        ("success", 9),
        ("force", 7),
        ("dropped", 5),
        ("force", 8),
        ("hung", 0),
        ("gate", 4),
    ]
    entries = [
        {"attempt": k, "outcome": o, "rows": rows, "reason": f"why {k}"}
        for k, (o, rows) in enumerate(ended)
    ]
    produced = SimpleNamespace(
        made=[Made(Artefact(Path(f"made {e['attempt']}"), ""), e) for e in entries]
    )
    store = SimpleNamespace(
        find=lambda _, k, __: None if k == 6 else Artefact(Path(f"store/{k}"), "")
    )
    plan = SimpleNamespace(
        steps=[SimpleNamespace(stage="")], config=lambda k: k, inputs=lambda k: []
    )
    assert view_commands(cast(Any, plan), cast(Any, produced), cast(Any, store)) == [
        "view:    taccorl view store/3  (dropped: why 3)",
        "view:    taccorl view store/2  (force: why 2)",
        "view:    taccorl view 'made 6'  (gate: why 6)",
    ]


@pytest.mark.slow
def test_what_never_succeeds_ends_with_a_command_that_shows_a_failure(
    collected, place, said, monkeypatch
):
    monkeypatch.setattr(AugmentPlan, "many", 1)
    spec = yaml.safe_load(mimic_spec_path("assembly_2").read_text()) | {
        "gates": {"max_force_n": 0.5}
    }
    (place / "strict.yaml").write_text(yaml.safe_dump(spec))
    words = (
        "--spec=strict.yaml",
        "--task=assembly_2",
        "--images=false",
        "--out=strict",
        "--store=store",
    )
    code, text = said("augment", f"--source={collected}", *words)
    assert code == 2 and "1 of 1 failed (1 force); nothing was written" in text
    command = shlex.split(text.rpartition("To view one: ")[2])
    assert command[:2] == ["taccorl", "view"]
    assert said(*command[1:], "--save=failed.rrd")[0] == 0
    assert (place / "failed.rrd").stat().st_size > 10_000
    episode = attempt_episode(Path(command[2]))
    assert not episode.success
    assert "force: " in episode.name


def test_a_recording_without_simulator_state_is_refused_with_the_command_that_collects(
    collected, said, tmp_path
):
    shutil.copytree(collected, tmp_path / "real")
    path = tmp_path / "real" / "meta" / "info.json"  # as of a robot's recording
    info = json.loads(path.read_text())
    info["features"] = {
        key: f for key, f in info["features"].items() if not key.startswith("sim.")
    }
    path.write_text(json.dumps(info))
    shutil.rmtree(tmp_path / "real" / "meta" / "taccorl")
    code, text = said(
        "augment", f"--source={tmp_path / 'real'}", "--task=assembly_2", "--out=x"
    )
    assert code == 2
    assert "has no sim.state" in text
    assert "taccorl collect --task=assembly_2 --out=outputs/assembly_2" in text


def test_what_the_twin_made_has_nothing_to_warn_of(collected, place, said):
    for dataset in (collected, place / "new"):
        code, text = said("check", dataset)
        assert (code, "warning" in text, "error" in text) == (0, False, False), text


@pytest.mark.parametrize("verb", ["augment", "merge"])
def test_sources_with_one_flipped_byte_are_refused_by_name(
    collected, said, tmp_path, verb
):
    shutil.copytree(collected, tmp_path / "flipped")
    (path,) = (tmp_path / "flipped" / "data").rglob("*.parquet")
    content = bytearray(path.read_bytes())
    content[1000] ^= 1
    path.write_bytes(content)
    of = {
        "augment": (f"--source={tmp_path / 'flipped'}", "--task=assembly_2"),
        "merge": (f"--sim={tmp_path / 'flipped'}",),
    }
    code, text = said(
        verb, *of[verb], f"--out={tmp_path / 'x'}", f"--store={tmp_path / 'store'}"
    )
    assert code == 2
    assert "data/chunk-000/file-000.parquet is damaged or changed" in text
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--task=asembly_2",), "no task 'asembly_2'; did you mean 'assembly_2'?"),
        (("--task=assembly_1", "--out=x"), "is of assembly_2: --task=assembly_2, or"),
        (
            ("--task=assembly_2", "--spec=puzzle"),
            "--spec=puzzle is of task puzzle, --task=assembly_2",
        ),
        (("--task=assembly_2", "--difficulty=hrad"), "did you mean 'hard'?"),
        (("--task=assembly_2", "--twin=no.yaml"), "no.yaml"),
        (
            ("--task=assembly_2", "--engine.workers=0"),
            "augment: --engine.workers=0: give at least one",
        ),
        (("--task=assembly_2", "--episodes=0"), "--episodes=0: at least 1"),
        (
            ("--task=assembly_2", "--out=store/x", "--store=store"),
            "contain one another",
        ),
        (("--task=assembly_2", "--source=nowhere"), "nowhere: no such folder"),
        (
            (*WORDS[:3], "--out=mine", "--store=store"),
            "mine is occupied: it is a folder of 1 entries without",
        ),
        ((*WORDS, "--seed=1"), "which differs in attempts (source, seed, number"),
        ((*WORDS, "--episodes=3"), "new is occupied: it holds augmented v4"),
    ],
)
def test_what_cannot_work_is_named_before_any_attempt(
    words, expected, collected, place, said, monkeypatch
):
    monkeypatch.setattr(
        AugmentPlan, "run", lambda *_: pytest.fail("an attempt was made")
    )
    (place / "mine").mkdir(exist_ok=True)
    (place / "mine" / "work.txt").write_text("x")
    options = {
        word.partition("=")[0]: word for word in (f"--source={collected}", *words)
    }  # the last one counts
    code, text = said("augment", *options.values())
    assert code == 2
    assert expected in text
    assert (place / "mine" / "work.txt").read_text() == "x"
    assert not (place / "x").exists()
