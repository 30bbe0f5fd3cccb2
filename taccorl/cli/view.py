"""``taccorl view PATH [--episode=0] [--spec=piper_flexitac_mcap]``: an episode in Rerun.

PATH is a LeRobot dataset's folder, a recording with the spec that reads it, or an attempt of ``taccorl augment`` in the store,
which is executed again. Opens a window; where there is no screen: --serve, --save, --screenshot or --sheet.

``taccorl view A --against=B [--against_episode=0] [--align=contact]``: two episodes in one view, on one time line. B is what A
may be, or a twin.yaml: that twin executes the actions of A on an empty bench, without pictures and touch.
"""

import contextlib
import dataclasses
import shlex
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

from taccorl.cli.ingest import chosen_spec
from taccorl.cli.parse import given_names, parse
from taccorl.data.file_kinds import no_recording
from taccorl.errors import TaccorlError, nearest, no_such_path

if TYPE_CHECKING:
    from taccorl.data.episode import Episode
    from taccorl.views.pair import Align, Pair

    Shown = Episode | Pair


ALIGNMENTS = ("start", "contact")
"""Values of ``ViewConfig.align``."""


@dataclass(kw_only=True)
class ViewConfig:
    """Show an episode in Rerun."""

    path: Path
    """A LeRobot dataset's folder, a recording, or an attempt of `taccorl augment` in the store."""
    episode: int = 0
    """Number of the episode, counted from 0."""
    spec: str | None = None
    """Recording spec; chosen by a recording's topics if not given."""
    against: Path | None = None
    """Also show this episode (B) beside the one of `path` (A): a dataset, a recording, an attempt, or a twin.yaml, whose twin
    executes the actions of A."""
    against_episode: int = 0
    """Number of the episode in `against`, counted from 0."""
    against_spec: str | None = None
    """Recording spec of `against`; `spec` if not given."""
    align: str = "start"
    """Time 0 of two episodes, with `against`. start: their first rows; contact: their first contacts."""
    start_s: float | None = None
    """First time to show: seconds since the episode's first row; with `against`, of each."""
    end_s: float | None = None
    """Time at which to stop, in the same seconds."""
    save: Path | None = None
    """Rerun file (.rrd) to write. An earlier one of taccorl is replaced; other files are not overwritten."""
    serve: bool = False
    """Serve a web page with the view on this machine until Ctrl-C."""
    screenshot: Path | None = None
    """Picture of the view to write (.png), where touch is strongest; overwrites as `save` does."""
    sheet: Path | None = None
    """Contact sheet to write (.png): pictures and pads at some instants, touch and grippers over time; overwrites as `save`
    does."""


def main(argv: list[str]) -> int:
    """Run ``taccorl view`` with the words ``argv`` after it; returns the exit status of ``run``."""
    return run(parse(ViewConfig, argv, positional="path"), given_names(argv))


def run(config: ViewConfig, given: Collection[str] = ()) -> int:
    """Show the episode, or write files of it. Returns the exit status 0. ``given``: names of options that a user typed, of
    which those without effect are refused."""
    _check_outputs(config)
    _check_against(config, given)
    with contextlib.ExitStack() as stack:
        from taccorl.views.part import part_of

        whole = stack.enter_context(
            opened_episode(config.path, config.episode, config.spec, "--spec")
        )
        shown = episode = part_of(whole, config.start_s, config.end_s)
        if config.against is not None:
            from taccorl.views.pair import Pair

            other = stack.enter_context(_other(config, config.against, whole))
            shown = Pair(
                episode,
                part_of(other, config.start_s, config.end_s),
                cast("Align", config.align),
            )
            _note_other_touch(other, "against")
        for option in ("sheet", "against"):
            if getattr(config, option) is not None:
                _note_other_touch(episode, option)
        wrote = _write(config, shown)
        if config.serve:
            _serve(shown)
        elif not wrote:
            _open_window(shown)
    return 0


def _note_other_touch(episode: "Episode", option: str) -> None:
    """Touch that no sensor spec describes is in the view of one episode only."""
    from taccorl.views.touch import other_touch_of

    for touch in other_touch_of(episode):
        why = "it has no sensor spec; taccorl view of this episode alone shows it"
        print(f"not shown with --{option}: {touch.title}: {why}")


def _check_against(config: ViewConfig, given: Collection[str]) -> None:
    if config.align not in ALIGNMENTS:
        raise TaccorlError(
            f"--align={config.align}: {nearest(config.align, ALIGNMENTS)}"
        )
    useless = (
        sorted({"against_episode", "against_spec", "align"}.intersection(given))
        if config.against is None
        else []
    )
    if useless:
        raise TaccorlError(
            f"--{useless[0]} has no effect without --against=: remove it, or name the other episode"
        )
    if config.against is not None and config.sheet is not None:
        raise TaccorlError(
            "--sheet shows one episode: with --against=, use --screenshot=, or remove --against="
        )


@contextlib.contextmanager
def _other(config: ViewConfig, path: Path, episode: "Episode") -> Iterator["Episode"]:
    """Episode B."""
    if path.suffix in (".yaml", ".yml") and path.is_file():
        yield _replayed(path, episode)
        return
    is_dataset = (path / "meta" / "info.json").is_file()
    spec = config.against_spec if is_dataset else config.against_spec or config.spec
    with opened_episode(path, config.against_episode, spec, "--against_spec") as other:
        yield other


def _replayed(twin: Path, episode: "Episode") -> "Episode":
    """The actions of ``episode`` in that twin. What it touches is not in its scene, so touch is left out."""
    from taccorl.robots import ROBOT
    from taccorl.sim.bench import Bench
    from taccorl.sim.replay import replay_episode
    from taccorl.sim.simulation import Simulation
    from taccorl.sim.twin_file import load_twin

    shape = episode.arrays["action"].shape if "action" in episode.arrays else None
    if shape is None or shape[1:] != ROBOT.action_low.shape:
        raise TaccorlError(
            f"--against={twin}: a twin.yaml describes two PiPER arms, with {ROBOT.num_actions} targets per row; {episode.name} "
            f"has {'no action' if shape is None else f'{shape[1]}'}. Give another episode instead"
        )
    sim = Simulation(Bench(), load_twin(twin))
    sim.reset([0])
    done = replay_episode(sim, episode)
    if sim.diverged[0]:
        raise TaccorlError(
            f"--against={twin}: the twin diverged; check its gains and effects"
        )
    arrays = {
        key: values
        for key, values in done.arrays.items()
        if key not in done.spec.sensors
    }
    facts = {"twin": str(twin), "scene": "empty bench: no parts, no pictures, no touch"}
    name = f"{episode.name}, replayed in {twin}"
    return dataclasses.replace(
        done,
        name=name,
        arrays=arrays,
        success=None,
        stages=(),
        baselines={},
        provenance=facts,
    )


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
def opened_episode(
    path: Path,
    number: int,
    spec: str | None,
    option: str,
    say: Callable[[str], None] = print,
) -> Iterator["Episode"]:
    """Context manager that opens one episode of a dataset, a recording or an attempt,
    and closes its files.

    Args:
        option: name of the option for the recording's spec, for messages.
        say: function that gets what was chosen, and what is not shown.

    Raises:
        TaccorlError: there is no such file or episode, or a recording's spec is missing.
    """
    if (path / "meta" / "info.json").is_file() and spec is None:
        from taccorl.data.dataset import Dataset

        dataset = Dataset(path)
        for key, why in dataset.skipped.items():
            say(f"not shown: {key}: {why}")
        yield dataset.episode(number)
        return
    if not path.exists():
        raise TaccorlError(no_such_path(path))
    if spec is None and (path / "entry.json").is_file():
        from taccorl.episodes.sources.mimicgen.augment import (
            attempt_episode,
            is_attempt,
        )

        if is_attempt(path):
            yield attempt_episode(path)
            return
    if spec is None:
        if path.suffix.lower() in (".csv", ".parquet", ".mat"):
            text = "a table, for taccorl compare; view opens recordings (.mcap, .db3, .bag, .hdf5), and LeRobot datasets as "
            raise TaccorlError(
                f"{path}: {text}taccorl ingest, taccorl collect and lerobot-record make them"
            )
        if what := no_recording(path):
            raise TaccorlError(f"{path}: {what}")
        try:
            spec = chosen_spec([path], say)
        except TaccorlError as error:
            raise TaccorlError(str(error).replace("--spec=", f"{option}=")) from error
    from taccorl.data.cutting import open_episodes

    with open_episodes(path, spec) as episodes:
        if not 0 <= number < len(episodes):
            raise TaccorlError(
                f"{path}: no episode {number}; it has {len(episodes)}, counted from 0"
            )
        yield episodes[number]


def _write(config: ViewConfig, shown: "Shown") -> bool:
    """Was a file asked for?"""
    if config.save is not None:
        from taccorl.cli.progress import Bars
        from taccorl.views.pair_view import save_shown

        with Bars(1, "reading the episode") as bars:
            save_shown(shown, config.save, progress=bars.update)
        command = shlex.join(
            [str(Path(sys.executable).with_name("rerun")), str(config.save)]
        )
        print(f"wrote {config.save}: look at it with {command}")
    if config.sheet is not None:
        from taccorl.data.episode import Episode
        from taccorl.views.contact_sheet import contact_sheet

        assert isinstance(shown, Episode)  # checked by _check_against
        contact_sheet(shown, config.sheet)
        print(f"wrote {config.sheet}")
    if config.screenshot is not None:  # last: it alone needs what a machine may lack
        from taccorl.views.screenshot import screenshot

        screenshot(
            shown,
            config.screenshot,
            progress=lambda text: print(text, file=sys.stderr, flush=True),
        )
        print(f"wrote {config.screenshot}")
    return any(
        path is not None for path in (config.save, config.screenshot, config.sheet)
    )


@contextlib.contextmanager
def _as_file(shown: "Shown") -> Iterator[Path]:
    """The view as a Rerun file that is there while the context lasts."""
    from taccorl.cli.progress import Bars
    from taccorl.views.pair_view import save_shown

    with tempfile.TemporaryDirectory(prefix="taccorl_") as folder:
        with Bars(1, "reading the episode") as bars:
            save_shown(shown, Path(folder) / "episode.rrd", progress=bars.update)
        yield Path(folder) / "episode.rrd"


def _serve(shown: "Shown") -> None:
    from taccorl.views.viewer import served

    with _as_file(shown) as rrd:
        asked_to_end = threading.Event()
        for number in (
            signal.SIGINT,
            signal.SIGTERM,
        ):  # by hand, so that the server never outlives us
            signal.signal(number, lambda *_: asked_to_end.set())
        with served(rrd) as address:
            print(
                f"{address}\nopen this in a browser on this machine; Ctrl-C ends it",
                flush=True,
            )
            while not asked_to_end.wait(
                0.2
            ):  # without a timeout, a signal that meets another thread wakes nobody
                pass


def _open_window(shown: "Shown") -> None:
    from taccorl.views.viewer import open_window, require_screen

    require_screen()
    with _as_file(shown) as rrd:
        open_window(rrd)
