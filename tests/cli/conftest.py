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
def said(request, place, monkeypatch, capsys):
    """Runs ``taccorl WORDS`` in ``place``; (exit code, all that was printed). A file with ``VERB`` runs that one, without
    ``IN_PLACE`` where the tests run; one with ``ONE_LINE`` gets what was printed in one line."""
    verb = getattr(request.module, "VERB", None)
    if verb is None or hasattr(request.module, "IN_PLACE"):
        monkeypatch.chdir(place)

    def run(*words: Any, verb: str = verb or "") -> tuple[int, str]:
        code = main([*filter(None, [verb]), *map(str, words)])
        shown = capsys.readouterr()
        assert "Traceback" not in shown.out + shown.err
        text = shown.out + shown.err
        return code, " ".join(text.split()) if hasattr(
            request.module, "ONE_LINE"
        ) else text

    return run
