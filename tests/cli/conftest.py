"""Shared by tests of commands: one is run in this process, in a folder of its own."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from taccorl.cli.main import main

Said = Callable[..., tuple[int, str]]


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """The folder in which commands run: an empty one, unless the file has a fixture ``place`` of its own."""
    return tmp_path


@pytest.fixture
def said(place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Said:
    """Runs ``taccorl WORDS`` in ``place``; (exit code, all that was printed)."""
    monkeypatch.chdir(place)

    def run(*words: Any) -> tuple[int, str]:
        code = main(list(map(str, words)))
        shown = capsys.readouterr()
        assert "Traceback" not in shown.out + shown.err
        return code, shown.out + shown.err

    return run
