"""The program as a whole: its list of verbs, its help, its exit codes."""

import importlib
import json
import os
import pickle
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap.writer import Writer

import taccorl
from taccorl.cli import progress as tables
from taccorl.cli.check import CheckConfig
from taccorl.cli.evaluate import EvaluateConfig
from taccorl.cli.help import SHOWN
from taccorl.cli.ingest import IngestConfig, InspectConfig
from taccorl.cli.lineage import ExplainConfig, PruneConfig
from taccorl.cli.main import SECOND_WORDS, VERBS, main
from taccorl.cli.printed import give
from taccorl.cli.view import ViewConfig
from taccorl.errors import TaccorlError, printable
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
            assert callable(
                importlib.import_module(f"taccorl.cli.{verb.replace('-', '_')}").main
            )


@pytest.mark.parametrize(
    ("stated", "threads"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3")]
)
def test_a_diagnosis_computes_in_one_thread_unless_the_environment_states_more(
    stated, threads
):
    code = (
        "import atexit, os; atexit.register(lambda: print(os.environ['OPENBLAS_NUM_THREADS']));"
        "from taccorl.cli.main import main; main()"
    )
    own = [name for name in os.environ if name.endswith("_NUM_THREADS")]
    assert (
        fresh_python(
            "-c", code, "diagnose", "--help", without=own, **stated
        ).stdout.splitlines()[-1]
        == threads
    )


@pytest.mark.parametrize("words", [["-h"], ["--help"], []])
def test_the_list_is_no_error(words, capsys):
    assert main(words) == 0 and "usage: taccorl <verb>" in capsys.readouterr().out


def test_the_version_is_the_packages(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"taccorl {taccorl.__version__}\n"


@pytest.mark.parametrize(
    ("typo", "meant"), [("ingst", "ingest"), ("chekc", "check"), ("veiw", "view")]
)
def test_an_unknown_verb_names_the_nearest(typo, meant, capsys):
    assert main([typo, "x"]) == 2
    assert (
        capsys.readouterr().err
        == f"taccorl: no verb {typo!r}; did you mean {meant!r}?\n"
    )


def test_help_names_every_registered_task_but_the_empty_bench(capsys):
    from taccorl.sim.task import tasks

    with pytest.raises(SystemExit):
        main(["evaluate", "--help=all"])
    shown = capsys.readouterr().out.split("--task ", 1)[1].split("--against", 1)[0]
    assert {name for name in tasks if f" {name}" in shown} == set(tasks) - {"bench"}


def test_short_help_has_a_hundred_columns_forty_lines_and_few_options(capsys):
    verbs = {verb for group in VERBS.values() for verb in group} - {"lineage", "task"}
    assert verbs | {
        f"{v} {second}" for v, words in SECOND_WORDS.items() for second in words
    } == set(SHOWN)
    number = 0
    for verb, named in SHOWN.items():
        with pytest.raises(SystemExit):
            main([*verb.split(), "--help"])
        lines = capsys.readouterr().out.splitlines()
        shown = [line.split()[0] for line in lines if line.startswith("  --")]
        assert {f"--{name}" for name in named.split()} <= set(shown), verb
        assert len(lines) <= 40 and max(map(len, lines)) <= 100, verb
        number += len(shown)
    assert number <= 125


def test_help_shows_what_options_with_choices_are(capsys):
    """draccus overlooks the docstrings of Literal fields, also of those in a config within a config."""
    for verb, option, text in (
        (
            "diagnose",
            "--until {one,noise_floor}",
            "find the most likely missing effect of each joint",
        ),
        (
            "compare",
            "--pressed.shape {nothing,sphere,rod}",
            "Shape of the object. nothing: touch is not compared.",
        ),
    ):
        with pytest.raises(SystemExit):
            main([verb, "--help=all"])
        _, _, shown = " ".join(capsys.readouterr().out.split()).partition(option)
        assert text in shown.partition(" --")[0], option


@pytest.mark.parametrize(
    ("raised", "code", "words"),
    [
        (
            TaccorlError("front: no such topic"),
            2,
            "taccorl check: front: no such topic",
        ),
        (
            FileNotFoundError(2, "No such file or directory", "x.mcap"),
            2,
            "No such file or directory (x.mcap)",
        ),
        (OSError("odd"), 2, "taccorl check: odd"),
        (
            OSError(28, "No space left on device", "/out"),
            2,
            "No space left on device (/out); make room",
        ),
        (
            shutil.Error(
                [
                    ("a", "/out/a", "[Errno 28] No space left on device: '/out/a'"),
                    ("b", "/out/b", "the same"),
                ]
            ),
            2,
            "taccorl check: No space left on device (/out/a); make room, then run the same command again\n",
        ),
        (shutil.Error([("a", "/out/a", "odd")]), 2, "taccorl check: odd (/out/a)"),
        (KeyboardInterrupt(), 130, "taccorl check: stopped\n"),
        (
            KeyboardInterrupt(),
            130,
            "taccorl ingest: stopped; what was finished is kept",
        ),  # in its store
    ],
)
def test_what_a_verb_raises_becomes_one_line_and_an_exit_code(
    raised, code, words, monkeypatch, capsys
):
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
        (
            ("check", "full", "--spec=piper_flexitac_mcpa"),
            "did you mean 'piper_flexitac_mcap'",
        ),
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


@pytest.mark.parametrize(
    "words", [(), ("lineage", "--help"), ("ingest", "inspect", "{recording}")]
)
def test_a_reader_that_goes_away_is_no_error_message(words, tmp_path):
    from tests.recordings.stand_in import StandInConfig, write_mcap

    write_mcap(
        tmp_path / "a.mcap", StandInConfig(duration_s=2.0, camera_size=(96, 128))
    )
    read_end, write_end = os.pipe()
    os.close(read_end)  # as `taccorl … | head -0` does
    given = [w.format(recording=tmp_path / "a.mcap") for w in words]
    done = subprocess.run(
        [*TACCORL, *given], stdout=write_end, stderr=subprocess.PIPE, text=True
    )
    os.close(write_end)
    assert (done.returncode, done.stderr) == (141, "")


# ---- what verbs print while they work ----


def test_progress_without_a_terminal_is_a_line_now_and_then_with_rate_and_time_left(
    monkeypatch, capsys
) -> None:
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


def test_steps_of_a_search_are_a_line_now_and_then_also_from_another_process(
    monkeypatch, capsys
) -> None:
    now_s = 100.0
    monkeypatch.setattr(tables.time, "monotonic", lambda: now_s)
    steps = pickle.loads(pickle.dumps(tables.Steps()))
    for second in (1, 4, 6, 8, 12):
        now_s = 100.0 + second
        steps("elbow", f"step {second}")
    assert capsys.readouterr().err.splitlines() == [
        "elbow: step 6 (6 s)",
        "elbow: step 12 (12 s)",
    ]


# ---- names of other people's topics and files never steer the terminal ----

RED, BELL, BACKWARDS, C1 = "\x1b[31m", "\x07", "\u202e", "\x9b2J"
TOPIC = f"/arm{RED}/joint{BELL}_state{BACKWARDS}{C1}\nrow: 2"
TEXTS = f"/other{RED}"
STEERS = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e]")


def write(path: Path) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        joints = writer.register_schema(
            f"sensor_msgs/msg/JointState{RED}", "jsonschema", b"{}"
        )
        other = writer.register_schema("my_msgs/Unknown", "jsonschema", b"{}")
        message = {"name": [f"joint{RED}"], "position": [0.5]}
        for topic, schema in ((TOPIC, joints), (TEXTS, other)):
            channel = writer.register_channel(topic, "json", schema)
            for k in range(20):
                writer.add_message(
                    channel,
                    10**18 + k * 10**7,
                    json.dumps(message).encode(),
                    publish_time=0,
                )
        writer.add_metadata(f"note{RED}", {"by": f"{RED}me"})
        writer.finish()
    return path


def test_printable_writes_out_what_a_terminal_would_obey():
    assert printable(f"a{RED}b\n{BACKWARDS}") == r"a\x1b[31mb\n\u202e"
    assert printable("Größe → 3 µm, 😀") == "Größe → 3 µm, 😀"
    assert printable("\udcff") == r"\udcff"  # a file name that is not UTF-8


def test_what_inspect_prints_and_drafts_has_no_control_characters(tmp_path, capsys):
    path = write(tmp_path / f"a{RED}.mcap")
    assert main(["ingest", "inspect", str(path)]) == 0
    assert (
        main(["ingest", "inspect", str(path), f"--draft={tmp_path / 'mine.yaml'}"]) == 0
    )
    printed = capsys.readouterr().out
    assert (
        not STEERS.search(printed)
        and r"/arm\x1b[31m/joint\x07_state\u202e\x9b2J\nrow: 2" in printed
    )
    for name in ("mine.yaml", "mine_dataset.yaml"):
        assert not STEERS.search((tmp_path / name).read_text())
        assert yaml.safe_load((tmp_path / name).read_text())
    (channel,) = yaml.safe_load((tmp_path / "mine.yaml").read_text())[
        "channels"
    ].values()
    assert channel["topic"] == TOPIC
    assert channel["pick"] == [f"joint{RED}"]
    spare = r'# other_31m: {topic: "/other\u001b[31m", type: my_msgs/Unknown'
    assert spare in (tmp_path / "mine.yaml").read_text()


def test_errors_reports_and_lists_of_what_is_not_read_have_none_either(
    tmp_path, capsys
):
    folder = tmp_path / "in"
    folder.mkdir()
    write(folder / f"a{RED}.mcap")
    (folder / f"b{RED}.txt").write_text("?")
    for words in (["ingest", "--dry_run=true"], ["check"]):
        assert (
            main([words[0], str(folder), "--spec=piper_flexitac_mcap", *words[1:]]) == 1
        )
    assert main(["check", str(folder / f"c{RED}")]) == 2
    captured = capsys.readouterr()
    assert not STEERS.search(captured.out + captured.err)
    assert (
        r"a\x1b[31m.mcap" in captured.out
        and r"b\x1b[31m.txt" in captured.out
        and r"c\x1b[31m" in captured.err
    )


@pytest.mark.parametrize(("options", "shown"), [((), False), (("-W", "always"), True)])
def test_notes_of_numpy_do_not_reach_the_terminal_unless_python_is_asked_for_them(
    options: tuple[str, ...], shown: bool
):
    """Of the program and of a worker that it starts; Python's own -W shows them."""
    note = "import warnings; warnings.warn('empty mean', RuntimeWarning)"
    code = (
        "import subprocess, sys; from taccorl.cli.main import main; "
        f"sys.argv = ['taccorl', '--version']; main(); {note}; "
        f"subprocess.run([sys.executable, '-c', {note!r}])"
    )
    done = fresh_python(*options, "-c", code)
    assert done.returncode == 0 and ("empty mean" in done.stderr) == shown


@pytest.mark.parametrize("words", [["-V"], ["--version"]])
def test_the_version_is_one_line(words, capsys):
    assert main(words) == 0
    assert capsys.readouterr().out == f"taccorl {taccorl.__version__}\n"


def test_help_of_a_verb_is_its_help(capsys):
    with pytest.raises(SystemExit):
        main(["help", "ingest", "inspect"])
    shown = capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["ingest", "inspect", "--help"])
    assert shown == capsys.readouterr().out and "--draft" in shown
    assert main(["help"]) == 0 and "usage: taccorl <verb>" in capsys.readouterr().out
    assert main(["help", "colect"]) == 2 and "'collect'" in capsys.readouterr().err


def test_json_is_the_report_and_nothing_else(capfd, monkeypatch):
    monkeypatch.setattr("taccorl.cli.ingest.main", _reporting)
    assert main(["ingest", "x", "--json"]) == 1
    shown = capfd.readouterr()
    assert json.loads(shown.out) == {"rows": 3} and "a table" in shown.err
    assert main(["ingest", "x", "--quiet"]) == 1
    assert capfd.readouterr() == ("", "")
    assert main(["ingest", "x"]) == 1 and capfd.readouterr().out == "a table ['x']\n"


def _reporting(words: list[str]) -> int:
    print("a table", words)
    give(lambda: {"rows": 3})
    return 1


@pytest.mark.parametrize(
    "words", [["collect", "--json"], ["ingest", "inspect", "x", "--json"]]
)
def test_a_verb_without_a_report_refuses_json(words, capsys):
    assert main(words) == 2
    assert "ingest" in capsys.readouterr().err.partition("verbs with one:")[2]
