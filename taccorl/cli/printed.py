"""``--json`` and ``--quiet``, which every verb takes: what goes to stdout.

``--json``: the report as JSON and nothing else; what is otherwise printed goes to stderr.
``--quiet``: nothing; errors and progress stay on stderr. The exit status is the same.
"""

import contextlib
import io
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from taccorl.errors import TaccorlError

JSON = ("check", "compare", "diagnose", "evaluate", "ingest")
"""Verbs that have a report as JSON: they call ``give``."""
_FORMS = ("--json", "--quiet")
_given: list[Callable[[], Any]] = []


def give(report: Callable[[], Any]) -> None:
    """Keep the report of the running verb; ``report`` is called only for ``--json``."""
    _given[:] = [report]


def form_of(words: Sequence[str]) -> tuple[list[str], str]:
    """``words`` without --json and --quiet, and that one of them which was typed, or an
    empty text.

    Raises:
        TaccorlError: both were typed, or the verb has no report as JSON.
    """
    typed = [word for word in words if word in _FORMS]
    rest = [word for word in words if word not in _FORMS]
    if len({*typed}) > 1:
        raise TaccorlError("give either --json or --quiet")
    form = typed[0] if typed else ""
    if form == "--json" and (rest[0] not in JSON or rest[1:2] == ["inspect"]):
        raise TaccorlError(
            f"--json: no report as JSON; verbs with one: {', '.join(JSON)}"
        )
    return rest, form


@contextlib.contextmanager
def printed(form: str) -> Iterator[None]:
    """Context in which a verb runs; with ``--json`` its report is printed at the end."""
    _given.clear()
    if not form:
        yield
        return
    with contextlib.redirect_stdout(sys.stderr if form == "--json" else io.StringIO()):
        yield
    if form == "--json" and _given:
        print(json.dumps(_given[0](), indent=1, ensure_ascii=False))
