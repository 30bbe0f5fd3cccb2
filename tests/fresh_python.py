"""A new Python process, for tests of what a program imports, prints and returns."""

import os
import subprocess
import sys
from collections.abc import Collection
from pathlib import Path

ROOT = Path(__file__).parents[1]


def fresh_python(
    *words: object,
    cwd: Path = ROOT,
    path: Path = ROOT,
    without: Collection[str] = (),
    **variables: str,
) -> subprocess.CompletedProcess[str]:
    """``python WORDS`` in the folder ``cwd``, with its output as text; it finds what is in ``path``, and then the clone.
    ``without``: environment variables that it does not have; ``variables``: those that it has, too."""
    env = {key: value for key, value in os.environ.items() if key not in without}
    env |= {"PYTHONPATH": f"{path}:{ROOT}"} | variables
    return subprocess.run(
        [sys.executable, *map(str, words)],
        cwd=cwd,
        env=env,
        capture_output=True,
        text=True,
        timeout=300,
    )


def printed(*words: str, cwd: Path | None = None, **variables: str) -> str:
    """What a program prints, which must end without an error."""
    env = os.environ | {"HF_HUB_OFFLINE": "1"} | variables
    done = subprocess.run(
        words, cwd=cwd, env=env, capture_output=True, text=True, timeout=400
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-3000:]
    return done.stdout + done.stderr
