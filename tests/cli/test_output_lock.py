"""One command at a time writes to one place, and nothing is left of the lock; real processes, no waiting times."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from taccorl.cli.output_lock import hold, lock_files, released_at_the_end
from taccorl.cli.parse import parse
from taccorl.cli.surrogate import SurrogateConfig

HOLDER = """
import sys
from pathlib import Path
from taccorl.cli import main as cli
from taccorl.cli.output_lock import hold, released_at_the_end
import signal
signal.signal(signal.SIGTERM, cli._ended)
with released_at_the_end():
    hold(Path(sys.argv[1]))
    print("has it", flush=True)
    sys.stdin.readline()
"""


def start(folder: Path, *words: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, *words],
        cwd=folder,
        text=True,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def line(stream: Any) -> str:
    return stream.readline().strip()


@pytest.mark.parametrize("out", ["made", "new/folder/made"])
@pytest.mark.parametrize("ends", ["done", signal.SIGTERM, signal.SIGKILL])
def test_a_second_process_waits_until_the_first_ends_however_it_does(
    out: str, ends: Any, tmp_path: Path
):
    first = start(tmp_path, "-c", HOLDER, out)
    assert line(first.stdout) == "has it"
    second = start(tmp_path, "-c", HOLDER, out)
    said = line(second.stderr)
    assert f"waiting for --out={out}, held by process {first.pid}" in said
    if ends == "done":
        first.communicate("\n")
        assert first.returncode == 0
    else:
        first.send_signal(ends)
        first.communicate()
    assert line(second.stdout) == "has it"
    third = start(tmp_path, "-c", HOLDER, out)
    assert f"held by process {second.pid}" in line(third.stderr), (
        "the file that the first one removed is no other lock"
    )
    second.communicate("\n")
    assert line(third.stdout) == "has it"
    third.communicate("\n")
    assert [*tmp_path.rglob("*.lock")] == [] and [*tmp_path.iterdir()] == []


def test_two_names_of_one_place_are_one_lock_and_others_are_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "a").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "a")
    monkeypatch.chdir(tmp_path / "a")
    places = [Path("x"), tmp_path / "a" / "x", tmp_path / "link" / "x"]
    assert len({*map(str, map(lock_files, places))}) == 1
    assert lock_files(Path("y")) != lock_files(Path("x"))
    with released_at_the_end():
        hold(Path("x"))
        hold(tmp_path / "link" / "x")  # again, by the same command
        hold(Path("y"))
        assert len([*Path().glob(".*.lock")]) == 2
    assert [*Path().iterdir()] == []


@pytest.mark.parametrize(
    ("link", "target", "out"),
    [
        ("link", "made", "link"),
        ("link", "not/yet", "link"),
        ("link", "made", "link/not/yet"),
        ("second", "link", "second"),
    ],
)
def test_a_symbolic_link_to_the_place_is_the_same_lock(
    link: str, target: str, out: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    Path("made").mkdir()
    Path("link").symlink_to("made") if link != "link" else None
    Path(link).symlink_to(target)
    assert lock_files(Path(out)) == lock_files(Path(out).resolve())


def test_a_second_process_waits_after_the_first_created_the_folders_between(
    tmp_path: Path,
):
    first = start(tmp_path, "-c", HOLDER, "new/folder/made")
    assert line(first.stdout) == "has it"
    (tmp_path / "new/folder").mkdir(parents=True)
    (tmp_path / "link").symlink_to("new")
    second = start(tmp_path, "-c", HOLDER, "link/folder/made")
    assert f"held by process {first.pid}" in line(second.stderr)
    first.communicate("\n")
    assert line(second.stdout) == "has it"
    third = start(tmp_path, "-c", HOLDER, "new/folder/made")
    assert f"held by process {second.pid}" in line(third.stderr)
    second.communicate("\n")
    assert line(third.stdout) == "has it"
    third.communicate("\n")
    assert [*tmp_path.rglob("*.lock")] == []


def test_links_that_form_a_loop_are_left_to_the_command(tmp_path: Path):
    (tmp_path / "loop").symlink_to("loop")
    with released_at_the_end():
        hold(tmp_path / "loop")
        hold(tmp_path / "loop" / "x")


def test_what_cannot_be_locked_is_left_to_the_command(tmp_path: Path):
    with released_at_the_end():
        hold(Path("/proc/nothing/here"))
    if os.geteuid() != 0:
        tmp_path.chmod(0o500)
        with released_at_the_end():
            hold(tmp_path / "x")


def test_every_option_out_is_locked_where_it_is_parsed(tmp_path: Path):
    with released_at_the_end():
        parse(SurrogateConfig, [f"--out={tmp_path / 'made'}"])
        assert lock_files(tmp_path / "made")[-1].is_file()
    assert [*tmp_path.iterdir()] == []


@pytest.mark.slow
@pytest.mark.parametrize("where", [["--out=made"], []], ids=["given", "not given"])
def test_of_two_commands_into_one_place_one_writes_and_the_other_refuses(
    where: list[str], tmp_path: Path
):
    program = "import sys; from taccorl.cli.main import main; sys.exit(main())"
    words = ["-c", program, "surrogate", "--twin=drive.yaml", "--secret=1", *where]
    both = [start(tmp_path, *words) for _ in range(2)]
    said = [process.communicate()[1] for process in both]
    assert sorted(process.returncode for process in both) == [0, 2], said
    assert any("already exists" in text for text in said)
    assert not [*tmp_path.rglob(".*.lock")]
