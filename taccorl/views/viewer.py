"""Use the Rerun program on this machine: a window, a picture without a window, or a page for a browser (127.0.0.1 only)."""

import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import time
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path

from taccorl.errors import TaccorlError

LOOPBACK = "127.0.0.1"
START_TIMEOUT_S = 60.0
"""Longest time until the Rerun program answers [s]."""
PICTURE_TIMEOUT_S = 180.0
"""Longest time for one picture [s]."""


class ViewerError(TaccorlError):
    """Error: no viewer is available. The message names the missing program and the command that installs it."""


def require_screen() -> None:
    """Check that there is a screen for a window. Raises ViewerError: there is no screen; the message names the alternatives."""
    if sys.platform == "linux" and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise ViewerError(
            "there is no screen (no DISPLAY): use --serve=true, --save=… or --screenshot=…"
        )


def open_window(rrd: Path) -> None:
    """Show ``rrd`` in a window, and return when it is closed. Raises ViewerError: the Rerun program could not open one."""
    command = [
        _program(),
        str(rrd),
        "--bind",
        LOOPBACK,
        "--port",
        "auto",
        "--hide-welcome-screen",
    ]
    if subprocess.run(command, env=_environment(), check=False).returncode != 0:
        raise ViewerError(
            "the Rerun window did not open (see its message above): use --serve=true and a browser"
        )


def picture_without_window(
    rrd: Path, png: Path, width_px: int, height_px: int
) -> str | None:
    """Draw ``rrd`` into ``png`` without a window. Returns None, or the reason why that is not possible on this machine."""
    command = [
        _program(),
        str(rrd),
        "--headless",
        "--screenshot-to",
        str(png),
        "--bind",
        LOOPBACK,
        "--port",
        "auto",
    ]
    command += ["--window-size", f"{width_px}x{height_px}"]
    with tempfile.TemporaryDirectory(prefix="taccorl_") as folder:
        environment = _environment() | {"XDG_RUNTIME_DIR": folder}
        try:
            done = subprocess.run(
                command,
                env=environment,
                check=False,
                capture_output=True,
                text=True,
                timeout=PICTURE_TIMEOUT_S,
            )
        except subprocess.TimeoutExpired:
            return f"the Rerun program drew nothing within {PICTURE_TIMEOUT_S:.0f} s"
    if not png.is_file():
        said = [line for line in done.stderr.splitlines() if line.strip()]
        why = next(
            (line for line in said if "panicked" in line),
            said[-1] if said else f"exit status {done.returncode}",
        )
        return f"the Rerun program drew nothing: {why.strip()}"
    return None


@contextlib.contextmanager
def served(rrd: Path) -> Iterator[str]:
    """Context manager that serves a page with ``rrd`` and gives its address, which is reachable from this machine only."""
    page_port, data_port = _free_ports(2)
    command = [_program(), str(rrd), "--serve-web", "--bind", LOOPBACK]
    command += ["--web-viewer-port", str(page_port), "--port", str(data_port)]
    data = urllib.parse.quote(f"rerun+http://{LOOPBACK}:{data_port}/proxy", safe="")
    page = f"http://{LOOPBACK}:{page_port}/"
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(command, env=_environment(), stdout=log, stderr=log)
        try:
            _wait_for(page, process)
            yield f"{page}?url={data}&hide_welcome_screen"
        finally:
            process.terminate()
            process.wait(timeout=10)


def _program() -> str:
    """The binary inside the rerun-sdk package; ``python -m rerun`` would leave it running when it is ended."""
    import rerun_cli

    return str(Path(rerun_cli.__file__).parent / "rerun")


def _environment() -> dict[str, str]:
    """For a program that is about to be started; also sees to it that it starts with ordinary priority."""
    # Run as root, the AV1 encoder (SVT-AV1) makes the thread that opened it real-time, priority 99. Whatever that thread
    # starts inherits it, and a viewer that renders in software then keeps everybody else off the processor.
    if sys.platform == "linux" and os.sched_getscheduler(0) == os.SCHED_FIFO:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    # Without this, notes like "Listening for connections" cover the views.
    return os.environ | {"RUST_LOG": os.environ.get("RUST_LOG", "error")}


def _free_ports(num: int) -> list[int]:
    with contextlib.ExitStack() as stack:
        sockets = [
            stack.enter_context(socket.create_server((LOOPBACK, 0))) for _ in range(num)
        ]
        return [s.getsockname()[1] for s in sockets]


def _wait_for(page: str, process: subprocess.Popen) -> None:
    deadline_s = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline_s:
        if process.poll() is not None:
            raise ViewerError(
                f"the Rerun web viewer ended at once (exit status {process.returncode})"
            )
        with contextlib.suppress(OSError), urllib.request.urlopen(page, timeout=2):
            return
        time.sleep(0.1)
    raise ViewerError(
        f"the Rerun web viewer did not answer at {page} within {START_TIMEOUT_S:.0f} s"
    )
