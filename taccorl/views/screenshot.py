"""Draw the Rerun view as a picture without a screen, with the Rerun program."""

import tempfile
from collections.abc import Callable
from pathlib import Path

from PIL import Image

from taccorl.data.episode import Episode
from taccorl.views.outputs import save_png
from taccorl.views.pair import Pair
from taccorl.views.pair_view import save_shown
from taccorl.views.touch import pads_of, peak_row
from taccorl.views.viewer import PICTURE_TIMEOUT_S, ViewerError, picture_without_window

WIDTH_PX, HEIGHT_PX = 1600, 1000


def screenshot(
    shown: Episode | Pair,
    png: Path,
    *,
    progress: Callable[[str], None] = lambda text: None,
) -> None:
    """Draw the Rerun view of an episode or a pair as a PNG, where touch is strongest. ``progress``: function that is called with
    a text: the next step and how long it may take. Raises ViewerError: the Rerun program cannot draw here; OutputError: it
    exists and was not written by taccorl."""
    with tempfile.TemporaryDirectory(prefix="taccorl_") as folder:
        rrd, drawn = Path(folder) / "episode.rrd", Path(folder) / "drawn.png"
        progress(f"writing {shown.num_rows} rows for the viewer")
        save_shown(shown, rrd, at_s=best_time_s(shown))
        progress(f"drawing with the Rerun program, at most {PICTURE_TIMEOUT_S:.0f} s")
        if (
            why_not := picture_without_window(rrd, drawn, WIDTH_PX, HEIGHT_PX)
        ) is not None:
            install = "apt-get install mesa-vulkan-drivers libvulkan1"
            raise ViewerError(
                f"no screenshot: {why_not}. On Debian: {install}; --sheet=x.png needs nothing"
            )
        with Image.open(drawn) as image:
            save_png(image.convert("RGB"), png, shown.name, str(shown.origin))


def best_time_s(shown: Episode | Pair) -> float:
    """Time at which touch is strongest [s]; the middle of an episode without touch."""
    if isinstance(shown, Pair):
        return shown.best_time_s
    episode, pads = shown, pads_of(shown)
    row = peak_row(pads) if pads else episode.num_rows // 2
    return float(episode.time_s[row])
