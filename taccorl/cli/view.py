"""``taccorl view PATH [--episode=0] [--spec=piper_flexitac_mcap]``: an episode in Rerun.

PATH is a LeRobot dataset's folder, a recording with the spec that reads it, or an attempt of ``taccorl augment`` in the store,
which is executed again. Opens a window; where there is no screen:

    --serve=true          a page for a browser on this machine
    --save=x.rrd          a file for the Rerun program anywhere
    --screenshot=x.png    the view as a picture, where touch is strongest
    --sheet=x.png         a contact sheet: pictures and pads at a few instants, touch and grippers over time
"""

import contextlib
import shlex
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from taccorl.cli.parse import parse
from taccorl.data.file_kinds import no_dataset
from taccorl.errors import TaccorlError

if TYPE_CHECKING:
    from taccorl.data.episode import Episode


@dataclass(kw_only=True)
class ViewConfig:
    """Show an episode in Rerun."""

    path: Path
    """A LeRobot dataset's folder, a recording, or an attempt of `taccorl augment` in the store."""
    episode: int = 0
    """Number of the episode, counted from 0."""
    spec: str | None = None
    """Recording spec; needed for recordings."""
    start_s: float | None = None
    """Show rows from here on (seconds since the episode's first row)."""
    end_s: float | None = None
    """Show rows before this time."""
    save: Path | None = None
    """Write a Rerun file (.rrd). An earlier one of ours is replaced, any other file is left alone."""
    serve: bool = False
    """Serve a page for a browser on this machine until Ctrl-C."""
    screenshot: Path | None = None
    """Write the view as a picture (.png); replaces as `save` does."""
    sheet: Path | None = None
    """Write a contact sheet (.png); replaces as `save` does."""


def main(argv: list[str]) -> int:
    """Run ``taccorl view``; returns the exit status 0."""
    config = parse(ViewConfig, argv, positional="path")
    _check_outputs(config)
    with _opened(config) as whole:
        from taccorl.views.part import part_of

        episode = part_of(whole, config.start_s, config.end_s)
        _note_codecs(config, episode)
        wrote = _write(config, episode)
        if config.serve:
            _serve(episode)
        elif not wrote:
            _open_window(episode)
    return 0


def _check_outputs(config: ViewConfig) -> None:
    """Before any work is done: is there a place for what was asked for?"""
    from taccorl.views.outputs import check_free

    for option, path, ending in (
        ("save", config.save, ".rrd"),
        ("screenshot", config.screenshot, ".png"),
        ("sheet", config.sheet, ".png"),
    ):
        if path is not None:
            if path.suffix != ending:
                raise TaccorlError(f"--{option}={path}: must end in {ending}")
            check_free(path)


@contextlib.contextmanager
def _opened(config: ViewConfig) -> Iterator["Episode"]:
    if (config.path / "meta" / "info.json").is_file() and config.spec is None:
        from taccorl.data.dataset import Dataset

        dataset = Dataset(config.path)
        for key, why in dataset.skipped.items():
            print(f"not shown: {key}: {why}")
        yield dataset.episode(config.episode)
        return
    if not config.path.exists():
        raise TaccorlError(f"{config.path}: no such file or folder")
    if config.spec is None and (config.path / "entry.json").is_file():
        from taccorl.demos.mimicgen.augment import attempt_episode, is_attempt

        if is_attempt(config.path):
            yield attempt_episode(config.path)
            return
    if config.spec is None:
        raise TaccorlError(no_dataset(config.path))
    from taccorl.data.cutting import open_episodes

    with open_episodes(config.path, config.spec) as episodes:
        if not 0 <= config.episode < len(episodes):
            raise TaccorlError(f"{config.path}: no episode {config.episode}; it has {len(episodes)}, counted from 0")
        yield episodes[config.episode]


def _note_codecs(config: ViewConfig, episode: "Episode") -> None:
    from taccorl.views.video import codec_of
    from taccorl.views.viewer import can_decode

    codecs = sorted(c for c in {codec_of(video) for video in episode.videos.values()} if not can_decode(c))
    if config.save is not None and codecs:
        print(
            f"note: the Rerun program needs ffmpeg for {', '.join(codecs)} video and finds none: saved as JPEG pictures"
        )


def _write(config: ViewConfig, episode: "Episode") -> bool:
    """Was a file asked for?"""
    if config.save is not None:
        from taccorl.views.episode import save_episode

        save_episode(episode, config.save, native=True)
        command = shlex.join([str(Path(sys.executable).with_name("rerun")), str(config.save)])
        print(f"wrote {config.save}: look at it with {command}")
    if config.sheet is not None:
        from taccorl.views.contact_sheet import contact_sheet

        contact_sheet(episode, config.sheet)
        print(f"wrote {config.sheet}")
    if config.screenshot is not None:  # last: it alone needs what a machine may lack
        from taccorl.views.screenshot import screenshot

        who = screenshot(episode, config.screenshot, progress=lambda text: print(text, file=sys.stderr, flush=True))
        print(f"wrote {config.screenshot}, drawn by {who}")
    return any(path is not None for path in (config.save, config.screenshot, config.sheet))


def _serve(episode: "Episode") -> None:
    from taccorl.views.episode import save_episode
    from taccorl.views.viewer import served

    with tempfile.TemporaryDirectory(prefix="taccorl_") as folder:
        rrd = Path(folder) / "episode.rrd"
        save_episode(episode, rrd)
        asked_to_end = threading.Event()
        for number in (signal.SIGINT, signal.SIGTERM):  # by hand, so that the server never outlives us
            signal.signal(number, lambda *_: asked_to_end.set())
        with served(rrd) as address:
            print(f"{address}\nopen this in a browser on this machine; Ctrl-C ends it", flush=True)
            while not asked_to_end.wait(0.2):  # without a timeout, a signal that meets another thread wakes nobody
                pass


def _open_window(episode: "Episode") -> None:
    from taccorl.views.episode import save_episode
    from taccorl.views.viewer import open_window, require_screen

    require_screen()
    with tempfile.TemporaryDirectory(prefix="taccorl_") as folder:
        rrd = Path(folder) / "episode.rrd"
        save_episode(episode, rrd, native=True)
        open_window(rrd)
