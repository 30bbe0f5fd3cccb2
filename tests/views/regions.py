"""Where the views of a blueprint stand on a screenshot, as fractions of it, from the blueprint's own shares."""

from pathlib import Path

import numpy as np
import rerun.blueprint as rrb
from PIL import Image

TOP_BAR, TIME_PANEL, TITLE = 0.028, 0.030, 0.026
"""Heights of Rerun's menu bar, collapsed time panel and view titles in a window of 1000 points."""

Box = tuple[float, float, float, float]


def view_regions(blueprint: rrb.Blueprint) -> dict[str, Box]:
    """View's name → left, top, right, bottom of its content (without its title)."""
    found: dict[str, Box] = {}

    def walk(part: object, box: Box) -> None:
        left, top, right, bottom = box
        if not isinstance(part, rrb.Container):
            found[str(part.name)] = (left, top + TITLE, right, bottom)  # type: ignore[attr-defined]
            return
        contents = list(part.contents)
        if isinstance(
            part, rrb.Tabs
        ):  # the first is shown, below the bar of tabs, which is a view's title
            walk(
                contents[0],
                (
                    left,
                    top + TITLE * isinstance(contents[0], rrb.Container),
                    right,
                    bottom,
                ),
            )
            return
        if isinstance(part, rrb.Grid):
            columns = int(part.grid_columns or len(contents))
            width, height = (
                (right - left) / columns,
                (bottom - top) / -(-len(contents) // columns),
            )
            for k, child in enumerate(contents):
                x, y = left + k % columns * width, top + k // columns * height
                walk(child, (x, y, x + width, y + height))
            return
        horizontal = isinstance(part, rrb.Horizontal)
        shares = np.array(
            (part.column_shares if horizontal else part.row_shares)
            or [1] * len(contents),
            dtype=float,
        )
        edges = np.concatenate([[0.0], np.cumsum(shares / shares.sum())])
        for child, a, b in zip(contents, edges[:-1], edges[1:], strict=True):
            if horizontal:
                walk(
                    child,
                    (left + a * (right - left), top, left + b * (right - left), bottom),
                )
            else:
                walk(
                    child,
                    (left, top + a * (bottom - top), right, top + b * (bottom - top)),
                )

    walk(blueprint.root_container, (0.0, TOP_BAR, 1.0, 1.0 - TIME_PANEL))
    return found


def contents(png: Path, blueprint: rrb.Blueprint) -> dict[str, np.ndarray]:
    """View's name → its pixels, (rows, columns, 3), with a margin left out."""
    image = np.asarray(Image.open(png).convert("RGB"), dtype=float)
    height, width = image.shape[:2]
    cut = {}
    for name, (left, top, right, bottom) in view_regions(blueprint).items():
        rows = slice(round((top + 0.008) * height), round((bottom - 0.008) * height))
        columns = slice(round((left + 0.005) * width), round((right - 0.005) * width))
        cut[name] = image[rows, columns]
    return cut
