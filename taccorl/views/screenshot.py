"""Draw the Rerun view as a picture without a screen: with the Rerun program, else with a browser."""

import importlib.util
import io
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from taccorl.data.episode import Episode
from taccorl.views.outputs import save_png
from taccorl.views.pair import Pair
from taccorl.views.pair_view import save_shown
from taccorl.views.touch import pads_of, peak_row
from taccorl.views.viewer import PICTURE_TIMEOUT_S, ViewerError, picture_without_window, served

if TYPE_CHECKING:
    from playwright.sync_api import Page

WIDTH_PX, HEIGHT_PX = 1600, 1000
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
BROWSER_ARGUMENTS = (
    "--no-sandbox",  # root in a container has none
    "--use-angle=swiftshader",  # WebGL without a graphics card
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",  # the page may talk to nobody but us
)
SETTLE_S = 8.0
"""Time before the first shot [s]: a slowly loading web viewer looks complete, and does not change, before its first picture is
decoded."""
CALM_LEVELS = 0.2
"""Mean difference of two shots [levels of 255] below which the page has stopped changing."""
CALM_SHOTS = 3
"""Number of consecutive shots that must equal the one before: on a busy machine a view's text appears seconds after its
pictures."""
BLANK_LEVELS = 15.0
"""Standard deviation of a shot [levels of 255] below which the page shows nothing yet; measured: 8 while loading, 51 with all
views."""


def screenshot(shown: Episode | Pair, png: Path, *, progress: Callable[[str], None] = lambda text: None) -> str:
    """Draw the Rerun view of an episode or a pair as a PNG, where touch is strongest. Returns the name of the
    program that drew it. ``progress``: function that is called with a text: the next step and how long it may take. Raises
    ViewerError: neither the Rerun program nor a browser can draw on this machine; OutputError: ``png`` exists and was not written
    by taccorl."""
    with tempfile.TemporaryDirectory(prefix="taccorl_") as folder:
        rrd, drawn = Path(folder) / "episode.rrd", Path(folder) / "drawn.png"
        progress(f"writing {shown.num_rows} rows for the viewer")
        save_shown(shown, rrd, at_s=best_time_s(shown), native=True)
        progress(f"drawing with the Rerun program, at most {PICTURE_TIMEOUT_S:.0f} s")
        who, why_not = "the Rerun program", picture_without_window(rrd, drawn, WIDTH_PX, HEIGHT_PX)
        if why_not is not None:
            progress(f"{why_not}; drawing in a browser, at most {PICTURE_TIMEOUT_S:.0f} s")
            who, why_not_either = "a browser", picture_by_browser(rrd, drawn)
            if why_not_either is not None:
                raise ViewerError(
                    f"no screenshot: {why_not}; {why_not_either}. On Debian either of these is enough: "
                    f"apt-get install mesa-vulkan-drivers libvulkan1   or   apt-get install chromium && pip install playwright"
                )
        with Image.open(drawn) as image:
            save_png(image.convert("RGB"), png, shown.name, str(shown.origin))
    return who


def best_time_s(shown: Episode | Pair) -> float:
    """Time at which touch is strongest [s]; the middle of an episode without touch."""
    if isinstance(shown, Pair):
        return shown.best_time_s
    episode, pads = shown, pads_of(shown)
    row = peak_row(pads) if pads else episode.num_rows // 2
    return float(episode.time_s[row])


def picture_by_browser(rrd: Path, png: Path) -> str | None:
    """Draw ``rrd`` into ``png`` with Debian's chromium. Returns None, or the reason why that is not possible on this machine."""
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        return f"no browser: none of {', '.join(BROWSERS)} is installed"
    if importlib.util.find_spec("playwright") is None:
        return "no playwright to steer the browser"
    from playwright.sync_api import Error, sync_playwright

    try:
        with served(rrd) as address, sync_playwright() as playwright:
            chromium = playwright.chromium.launch(executable_path=browser, args=list(BROWSER_ARGUMENTS))
            page = chromium.new_page(viewport={"width": WIDTH_PX, "height": HEIGHT_PX}, color_scheme="dark")
            page.goto(f"{address}&renderer=webgl", wait_until="load", timeout=1e3 * PICTURE_TIMEOUT_S)
            shot = _settled_shot(page)
            chromium.close()
    except (Error, _NoPicture) as error:
        return f"the browser gave up: {' '.join(str(error).split())[:200]}"
    png.write_bytes(shot)
    return None


class _NoPicture(Exception):
    """The page failed, or never came to rest."""


def _settled_shot(page: "Page") -> bytes:
    """The first shot that shows something and is like those before it."""
    begin_s, before, calm = time.monotonic(), None, 0
    while time.monotonic() - begin_s < PICTURE_TIMEOUT_S:
        page.wait_for_timeout(1000)
        text = page.inner_text("body")  # the viewer draws on a canvas: text is a note about loading, or about failure
        if "error" in text.lower() or "crash" in text.lower():
            raise _NoPicture(text)
        shot = page.screenshot(timeout=1e3 * PICTURE_TIMEOUT_S)
        now = np.asarray(Image.open(io.BytesIO(shot)).convert("L"), dtype=float)
        calm = calm + 1 if before is not None and np.abs(now - before).mean() < CALM_LEVELS else 0
        if calm >= CALM_SHOTS and now.std() > BLANK_LEVELS and time.monotonic() - begin_s > SETTLE_S:
            return shot
        before = now
    raise _NoPicture(f"its page did not finish within {PICTURE_TIMEOUT_S:.0f} s")
