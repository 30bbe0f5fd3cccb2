"""Real pictures of the Rerun view, by the Rerun program without a window: every view shows its own things."""

import ctypes.util
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from PIL import Image

from taccorl.data.episode import Episode
from taccorl.views.blueprint import episode_blueprint
from taccorl.views.colors import CONTACT_COLOR, LINE_COLORS, PAD_COLORS, heat
from taccorl.views.screenshot import HEIGHT_PX, WIDTH_PX, screenshot
from taccorl.views.viewer import ViewerError, picture_without_window

from .made_episode import ORIGIN, in_dataset, made_episode
from .regions import contents

HAS_VULKAN = ctypes.util.find_library("vulkan") is not None and any(
    Path("/usr/share/vulkan/icd.d").glob("*.json")
)
needs_vulkan = pytest.mark.skipif(
    not HAS_VULKAN,
    reason="no Vulkan for the Rerun program: apt-get install mesa-vulkan-drivers libvulkan1",
)
TABLE = (176, 158, 136)
STRIP_SHADE = 0.785  # Rerun draws a lane's colours this much darker
SUCCESS, REACH, HOLD = (0x16, 0xA3, 0x4A), (0x25, 0x63, 0xEB), (0x0D, 0x94, 0x88)


@pytest.fixture(scope="module")
def episode(tmp_path_factory: pytest.TempPathFactory) -> Episode:
    """From a dataset, in H.264: the harder case for either viewer."""
    return in_dataset(made_episode(90), tmp_path_factory.mktemp("mp4"), codec="h264")


def share(pixels: np.ndarray, color: tuple[float, ...], tolerance: int = 22) -> float:
    """Of these pixels, how many have about this colour?"""
    return float((np.abs(pixels - np.array(color)).max(axis=2) < tolerance).mean())


def assert_every_view_shows_its_things(png: Path, episode: Episode) -> None:
    shown = contents(png, episode_blueprint(episode))
    for name, pixels in shown.items():
        assert pixels.std(axis=(0, 1)).max() > 15, f"{name}: nearly one colour"
    for camera in ("front", "left_wrist", "right_wrist"):
        assert share(shown[camera], TABLE) > 0.3, (
            f"{camera}: no table (a video that was not decoded?)"
        )
    touch = shown["touch: counts above baseline, 0 … 255, fixed colours"]
    for count in (
        80,
        110,
    ):  # patch on the left pads, middle of the stripe on the right ones, at full grip
        assert (
            share(touch, tuple(int(c) for c in heat(np.array(count / 255))), 40) > 0.005
        ), f"no taxel at {count}"
    strip = shown[f"contact gate, outcome, stage · {ORIGIN}"]
    for color in (CONTACT_COLOR, SUCCESS, REACH, HOLD):
        assert share(strip, tuple(STRIP_SHADE * c for c in color)) > 0.01, (
            f"strip: nothing in {color}"
        )
    for name in (
        "touch sum of active taxels [counts above baseline]",
        "touch peak [counts above baseline]",
    ):
        for color in (
            PAD_COLORS[1],
            PAD_COLORS[3],
        ):  # the pairs lie on one another, the later one on top
            assert share(shown[name], color, 60) > 0.001, f"{name}: no line in {color}"
    for name in ("left arm [rad]: action thin", "right arm [rad]: action thin"):
        for color in LINE_COLORS[:6]:
            assert share(shown[name], color, 60) > 0.0005, f"{name}: no line in {color}"
    assert share(shown["grippers [m]: action thin"], LINE_COLORS[1], 60) > 0.002
    red, green, blue = np.moveaxis(
        shown["arms (schematic): joints in the plots' colours"], 2, 0
    )
    assert (red - blue > 80).mean() > 0.005, "no orange right arm"
    assert (blue - red > 80).mean() > 0.005, "no blue left arm"
    assert (green - red > 80).mean() > 0.001, "no green elbow"
    assert (shown[f"provenance · {ORIGIN}"].min(axis=2) > 150).mean() > 0.005, "no text"


@pytest.mark.slow
@needs_vulkan
def test_the_rerun_program_draws_every_view(episode: Episode, tmp_path: Path):
    png = tmp_path / "view.png"
    screenshot(episode, png)
    assert_every_view_shows_its_things(png, episode)
    with Image.open(png) as image:
        assert image.info["Source"] == str(ORIGIN)


@needs_vulkan
def test_a_viewer_without_data_does_not_pass(episode: Episode, tmp_path: Path):
    with rr.RecordingStream("taccorl_episode") as rec:
        rec.save(
            tmp_path / "empty.rrd",
            default_blueprint=episode_blueprint(episode, at_s=1.8),
        )
        rec.log("provenance", rr.TextDocument("nothing else"), static=True)
        rec.disconnect()
    assert (
        picture_without_window(
            tmp_path / "empty.rrd", tmp_path / "empty.png", WIDTH_PX, HEIGHT_PX
        )
        is None
    )
    with pytest.raises(AssertionError):
        assert_every_view_shows_its_things(tmp_path / "empty.png", episode)


def test_a_machine_without_vulkan_is_told_what_to_install(
    episode, tmp_path, monkeypatch
):
    monkeypatch.setenv(
        "WGPU_BACKEND", "metal"
    )  # what the Rerun program finds on Linux without Vulkan: nothing
    told: list[str] = []
    with pytest.raises(
        ViewerError, match=r"apt-get install mesa-vulkan-drivers libvulkan1"
    ):
        screenshot(episode, tmp_path / "view.png", progress=told.append)
    assert (
        not list(tmp_path.iterdir())
        and "90 rows" in told[0]
        and "Rerun program, at most 180 s" in told[1]
    )
