"""The program as a whole: its list of verbs, its help, its exit codes."""

import importlib
import os
import pickle
import shutil
import subprocess
import sys
from typing import Any

import pytest

import taccorl
from taccorl.cli import progress as tables
from taccorl.cli.check import CheckConfig
from taccorl.cli.evaluate import EvaluateConfig
from taccorl.cli.help import SHOWN
from taccorl.cli.ingest import IngestConfig, InspectConfig
from taccorl.cli.lineage import ExplainConfig, PruneConfig
from taccorl.cli.main import SECOND_WORDS, VERBS, main
from taccorl.cli.view import ViewConfig
from taccorl.errors import TaccorlError
from tests.fresh_python import fresh_python

HELP = {
    ("ingest",): IngestConfig,
    ("ingest", "inspect"): InspectConfig,
    ("check",): CheckConfig,
    ("view",): ViewConfig,
    ("evaluate",): EvaluateConfig,
    ("lineage", "explain"): ExplainConfig,
    ("lineage", "prune"): PruneConfig,
}
TACCORL = [sys.executable, "-m", "taccorl.cli.main"]


def test_the_list_names_every_verb_and_needs_no_library():
    heavy = "{'numpy', 'torch', 'lerobot', 'draccus', 'rich', 'yaml'}"
    code = f"import sys; from taccorl.cli.main import main; main([]); print({heavy} & set(sys.modules) or 'light')"
    done = fresh_python("-c", code)
    *listing, loaded = done.stdout.splitlines()
    assert loaded == "light"
    for group, verbs in VERBS.items():
        assert group in listing
        for verb, line in verbs.items():
            assert f"  {verb:16s}{line}" in listing
            assert callable(importlib.import_module(f"taccorl.cli.{verb.replace('-', '_')}").main)


@pytest.mark.parametrize(("stated", "threads"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3")])
def test_a_diagnosis_computes_in_one_thread_unless_the_environment_states_more(stated, threads):
    code = (
        "import atexit, os; atexit.register(lambda: print(os.environ['OPENBLAS_NUM_THREADS']));"
        "from taccorl.cli.main import main; main()"
    )
    own = [name for name in os.environ if name.endswith("_NUM_THREADS")]
    assert fresh_python("-c", code, "diagnose", "--help", without=own, **stated).stdout.splitlines()[-1] == threads


@pytest.mark.parametrize("words", [["-h"], ["--help"], []])
def test_the_list_is_no_error(words, capsys):
    assert main(words) == 0
    assert "usage: taccorl <verb>" in capsys.readouterr().out


def test_the_version_is_the_packages(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"taccorl {taccorl.__version__}\n"


@pytest.mark.parametrize(("typo", "meant"), [("ingst", "ingest"), ("chekc", "check"), ("veiw", "view")])
def test_an_unknown_verb_names_the_nearest(typo, meant, capsys):
    assert main([typo, "x"]) == 2
    assert capsys.readouterr().err == f"taccorl: no verb {typo!r}; did you mean {meant!r}?\n"


def test_help_names_every_registered_task_but_the_empty_bench(capsys):
    from taccorl.sim.task import tasks

    with pytest.raises(SystemExit):
        main(["evaluate", "--help=all"])
    shown = capsys.readouterr().out.split("--task ", 1)[1].split("--against", 1)[0]
    assert {name for name in tasks if f" {name}" in shown} == set(tasks) - {"bench"}


def test_short_help_has_a_hundred_columns_forty_lines_and_few_options(capsys):
    verbs = {verb for group in VERBS.values() for verb in group} - {"lineage", "task"}
    assert verbs | {f"{v} {second}" for v, words in SECOND_WORDS.items() for second in words} == set(SHOWN)
    number = 0
    for verb, named in SHOWN.items():
        with pytest.raises(SystemExit):
            main([*verb.split(), "--help"])
        lines = capsys.readouterr().out.splitlines()
        shown = [line.split()[0] for line in lines if line.startswith("  --")]
        assert {f"--{name}" for name in named.split()} <= set(shown), verb
        assert len(lines) <= 40 and max(map(len, lines)) <= 100, verb
        number += len(shown)
    assert number <= 120


def test_help_shows_what_options_with_choices_are(capsys):
    """draccus overlooks the docstrings of Literal fields, also of those in a config within a config."""
    for verb, option, text in (
        ("diagnose", "--until {one,noise_floor}", "find the most likely missing effect of each joint"),
        ("compare", "--pressed.shape {nothing,sphere,rod}", "Shape of the object. nothing: touch is not compared."),
    ):
        with pytest.raises(SystemExit):
            main([verb, "--help=all"])
        _, _, shown = " ".join(capsys.readouterr().out.split()).partition(option)
        assert text in shown.partition(" --")[0], option


@pytest.mark.parametrize(
    ("raised", "code", "words"),
    [
        (TaccorlError("front: no such topic"), 2, "taccorl check: front: no such topic"),
        (FileNotFoundError(2, "No such file or directory", "x.mcap"), 2, "No such file or directory (x.mcap)"),
        (OSError("odd"), 2, "taccorl check: odd"),
        (OSError(28, "No space left on device", "/out"), 2, "No space left on device (/out); make room"),
        (
            shutil.Error(
                [("a", "/out/a", "[Errno 28] No space left on device: '/out/a'"), ("b", "/out/b", "the same")]
            ),
            2,
            "taccorl check: No space left on device (/out/a); make room, then run the same command again\n",
        ),
        (shutil.Error([("a", "/out/a", "odd")]), 2, "taccorl check: odd (/out/a)"),
        (KeyboardInterrupt(), 130, "taccorl check: stopped\n"),
        (KeyboardInterrupt(), 130, "taccorl ingest: stopped; what was finished is kept"),  # in its store
    ],
)
def test_what_a_verb_raises_becomes_one_line_and_an_exit_code(raised, code, words, monkeypatch, capsys):
    def fail(argv: Any) -> int:
        raise raised

    verb = "ingest" if "kept" in words else "check"
    monkeypatch.setattr(f"taccorl.cli.{verb}.main", fail)
    assert main([verb, "x"]) == code
    shown = capsys.readouterr().err
    assert words in shown and "Traceback" not in shown
    assert len(shown.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("collect", "--task=nope"), "nope"),
        (("collect", "--task=assembly_1", "--episodes=0"), "--episodes=0"),
        (("collect", "--task=assembly_1", "--out=full"), "full"),
        (("augment", "--task=assembly_2", "--source=nope"), "nope"),
        (("merge", "--real=full", "--out=new"), "full"),
        (("ingest", "full", "--spec=piper_flexitac_mcap", "--out=new"), "full"),
        (("align", "full", "--workers=0"), "--workers=0"),
        (("diagnose", "full", "--workers=0"), "--workers=0"),
        (("excite", "left_joint2", "--num=0"), "--num=0"),
        (("excite", "left_joint2", "--floor_rad=nan"), "--floor_rad=nan"),
        (("surrogate", "--secret=1", "--strength=0"), "--strength=0"),
        (("check", "full", "--spec=piper_flexitac_mcpa"), "did you mean 'piper_flexitac_mcap'"),
        (("ingest", "inspect", "nope"), "taccorl ingest inspect: nope"),
        (("lineage", "explain", "nope"), "taccorl lineage explain: "),
    ],
)
def test_a_refused_command_makes_no_store(words, named, tmp_path, said):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    code, shown = said(*words)
    assert code == 2 and named in shown
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["full", "notes.txt"]


@pytest.mark.parametrize("words", [(), ("lineage", "--help"), ("ingest", "inspect", "{recording}")])
def test_a_reader_that_goes_away_is_no_error_message(words, tmp_path):
    from tests.recordings.stand_in import StandInConfig, write_mcap

    write_mcap(tmp_path / "a.mcap", StandInConfig(duration_s=2.0, camera_size=(96, 128)))
    read_end, write_end = os.pipe()
    os.close(read_end)  # as `taccorl … | head -0` does
    given = [w.format(recording=tmp_path / "a.mcap") for w in words]
    done = subprocess.run([*TACCORL, *given], stdout=write_end, stderr=subprocess.PIPE, text=True)
    os.close(write_end)
    assert (done.returncode, done.stderr) == (141, "")


# ---- what verbs print while they work ----


def test_progress_without_a_terminal_is_a_line_now_and_then_with_rate_and_time_left(monkeypatch, capsys) -> None:
    now_s = 100.0
    monkeypatch.setattr(tables.time, "monotonic", lambda: now_s)
    with tables.Bars(2) as bars:
        for second in range(13):  # 50 rows a second
            now_s = 100.0 + second
            bars.update("a.mcap", 50 * second, 1000)
        now_s = 117.0
        bars.update("b.mcap", 0, 400)
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "a.mcap: 250 of 1000, 50/s, 15 s left",  # 750 rows at 50/s
        "a.mcap: 500 of 1000, 50/s, 10 s left",
        "b.mcap: 0 of 400",
    ]


def test_steps_of_a_search_are_a_line_now_and_then_also_from_another_process(monkeypatch, capsys) -> None:
    now_s = 100.0
    monkeypatch.setattr(tables.time, "monotonic", lambda: now_s)
    steps = pickle.loads(pickle.dumps(tables.Steps()))
    for second in (1, 4, 6, 8, 12):
        now_s = 100.0 + second
        steps("elbow", f"step {second}")
    assert capsys.readouterr().err.splitlines() == ["elbow: step 6 (6 s)", "elbow: step 12 (12 s)"]
