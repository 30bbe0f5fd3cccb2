"""A path at which there is nothing is refused before anything is loaded, and with the way out."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from taccorl.cli.main import main

RUN = """
import sys
from taccorl.cli.main import main
code = main(sys.argv[1:])
loaded = sorted({"scipy", "mujoco", "numba", "matplotlib"} & {*sys.modules})
print("code", code, "loaded", *loaded)
"""


@pytest.mark.parametrize("verb", ["compare", "diagnose", "align"])
@pytest.mark.parametrize(
    ("words", "missing"),
    [
        (["nothing"], "nothing: no such file or folder"),
        (["here", "--twin=robot.yaml"], "robot.yaml: no such file"),
        (["here", "--columns=columns.yaml"], "columns.yaml: no such file"),
    ],
)
def test_nothing_is_loaded_for_a_path_that_does_not_exist(
    verb, words, missing, tmp_path: Path
):
    (tmp_path / "here").mkdir()
    out = [] if verb == "compare" else ["--out=out"]
    done = subprocess.run(
        [sys.executable, "-c", RUN, verb, *words, *out],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
    )
    assert missing in done.stderr
    assert done.stdout.split() == ["code", "2", "loaded"]
    assert not (tmp_path / "out").exists()


def test_a_name_on_the_hub_is_not_fetched_and_how_it_is(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["check", "lerobot/pusht"]) == 2
    printed = capsys.readouterr().err
    assert "hf download lerobot/pusht --repo-type=dataset --local-dir=pusht" in printed
    assert main(["check", "./pusht"]) == 2
    assert "hf download" not in capsys.readouterr().err


def test_another_robots_table_without_its_file_asks_for_the_file(tmp_path, capsys):
    (tmp_path / "a.csv").write_text(
        "t,pan.q,pan.q_target\n" + "".join(f"{k / 100},0,0\n" for k in range(9)),
        encoding="utf-8",
    )
    assert main(["compare", str(tmp_path / "a.csv")]) == 2
    printed = capsys.readouterr().err
    assert "without a robot file (--twin=robot.yaml" in printed
    assert "'pan'" in printed and "init-robot" in printed
