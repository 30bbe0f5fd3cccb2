"""``make pictures``: the tasks as the cameras see them (docs/task_*.png), and their rows in docs/twin.md; an insertion
beside what the pads read (docs/insertion.gif); a joint's twin before and after (docs/mended_twin.png). All simulated."""

import re
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from PIL import Image, ImageDraw
from PIL.ImageFont import load_default as font

import taccorl
from pipelines.studies import so101
from taccorl.alignment.machines.robot_draft import StatedFacts, robot_draft, servo_of
from taccorl.diagnosis.comparison.result import shown_unit
from taccorl.episodes.sources.collect import CollectPlan
from taccorl.episodes.sources.expert import ExpertSource
from taccorl.report.figure_style import (
    AFTER,
    BEFORE,
    MEASURED,
    floor_band,
    legend,
    new_figure,
    tidy,
)
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.tasks.experts import tasks_with_expert
from taccorl.views.colors import PAD_COLORS, heat

VIEWS = (ROBOT.cameras[0], ROBOT.cameras[-1])
MOMENTS = (0.0, 0.4, 0.75, 1.0)  # shares of the episode
SIZE = (240, 320)  # rows, columns of a picture
OUT = Path("docs")
PAGE = OUT / "twin.md"
SHOWN, EVERY, HOLD_MS = (
    "assembly_1",
    5,
    1500,
)  # task of the GIF; control steps a frame; how long the last one stays
FULL_COUNTS = 200  # end of the colour scale


def with_rows(page: str) -> str:
    """The page with one row for each task in its table of pictures."""
    rows = [
        f"| `{name}` | ![{tasks.get(name).instruction}](task_{name}.png) |\n"
        for name in tasks_with_expert()
    ]
    return re.sub(
        r"(?<=^\|---\|---\|\n)(\|.*\n)+",
        "".join(rows),
        page,
        count=1,
        flags=re.MULTILINE,
    )


def episode(
    sim: Simulation, plan: CollectPlan, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """States (T, row_size) and touch (T, pads, rows, columns), counts, of one successful attempt."""
    for k in range(20):
        sim.reset([seed + k])
        states, counts = [], []
        for targets in plan.source.actions(sim, np.random.default_rng([seed + k, 1])):
            states.append(sim.state_rows()[0])
            counts.append(
                sim.touch()[0].reshape(
                    len(ROBOT.pads), ROBOT.pad.rows, ROBOT.pad.columns
                )
            )
            sim.step(targets.sent[None].astype(float))
            if sim.judge.outcome.over[0]:
                break
        if sim.judge.outcome.success[0]:
            return np.array(states), np.array(counts)
    raise SystemExit(f"{plan.task}: no success in 20 attempts")


def insertion(
    sim: Simulation, states: np.ndarray, counts: np.ndarray
) -> list[Image.Image]:
    """Frames of ``states`` (T, row_size) from the first touch on: the picture of the first camera, the pads (T, pads, rows,
    columns) in counts, the sum of each pad over time."""
    total = counts.clip(min=0).sum((2, 3))
    first, frames = int((total.sum(1) > FULL_COUNTS).argmax()), []
    rows = list(range(first, len(states), EVERY))
    wide, high, across = 452, 339, 78
    for k, pictures in zip(
        rows, sim.render_states(states[rows], VIEWS[:1], size=(720, 960)), strict=True
    ):
        frame = Image.new("RGB", (800, 430), "white")
        draw = ImageDraw.Draw(frame)
        frame.paste(
            Image.fromarray(pictures[VIEWS[0]][60:510, 180:780]).resize(
                (wide, high), Image.Resampling.LANCZOS
            ),
            (0, 0),
        )
        for n, name in enumerate(ROBOT.pads):
            left = wide + 12 + n * (across + 6)
            pad = Image.fromarray(heat(counts[k, n] / FULL_COUNTS)).resize(
                (across, 213), Image.Resampling.NEAREST
            )
            frame.paste(pad, (left, 34))
            draw.text(
                (left + across / 2, 28),
                name.replace("_", " "),
                "black",
                font(16),
                anchor="ms",
            )
            x = 130 + 650 * np.arange(k - first + 1) / (len(states) - 1 - first)
            y = 420 - 70 * total[first : k + 1, n] / total.max()
            draw.line(list(zip(x, y, strict=True)), PAD_COLORS[n], 3)
            draw.text(
                (left + across / 2, 268),
                f"{total[k, n]:.0f}",
                PAD_COLORS[n],
                font(18),
                anchor="ms",
            )
        draw.text(
            (wide + 12, 280),
            "four tactile pads, 32 x 12 taxels each; sum of",
            "black",
            font(15),
        )
        draw.text(
            (wide + 12, 300),
            f"counts below, 0 … {FULL_COUNTS} counts a taxel",
            "black",
            font(15),
        )
        draw.text((8, 366), "touch of each\npad over time", "black", font(15))
        draw.text(
            (8, 316), f"{sim.task.name}, simulated, {k / 30:.1f} s", "white", font(16)
        )
        frames.append(frame.quantize(128, dither=Image.Dither.NONE))
    return frames


def mended_twin() -> None:
    """Draw the example of README.md, a simulated arm: what was measured, its model and the
    model with the effect that ``diagnose`` names; the residuals below. No choice used the
    recording that is shown."""
    with TemporaryDirectory() as place:
        so101.write(Path(place) / "arm")
        out = Path(place) / "so101.yaml"
        stated = StatedFacts(servo=servo_of("so101"))
        out.write_text(robot_draft(Path(place) / "arm/so101.xml", out, stated)[0])
        robot = taccorl.load_robot(out)
        sweeps = taccorl.read_measurements(Path(place) / "arm/sweeps", robot)
        found = taccorl.diagnose(robot, sweeps)
        mended = taccorl.add_effect(robot, "gear_friction", found)
        both = taccorl.compare(robot, sweeps, against=mended)
    assert both.after is not None
    model, corrected = (
        next(t for t in side.traces if t.recording == "last.csv")
        for side in (both.comparison, both.after)
    )
    title = "Elbow of a simulated SO-101, a test recording"
    figure = new_figure(7.2, 5.0, title, [model.origin])
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    above.plot(model.time_s, model.measured, color=MEASURED, lw=2.6, label="measured")
    floor_band(below, model.floor.value, model.unit)
    factor, unit = shown_unit(model.unit)
    for trace, color, name in (
        (model, BEFORE, "model"),
        (corrected, AFTER, "model + gear_friction"),
    ):
        above.plot(trace.time_s, trace.replayed, color=color, lw=1.2, label=name)
        rmse = float(np.sqrt(np.mean(trace.residual**2))) * factor
        label = f"{name}: RMS {rmse:.3g} {unit}"
        below.plot(trace.time_s, trace.residual * factor, color=color, label=label)
    tidy(above, y="position [rad]")
    tidy(below, "time [s]", f"measured − model [{unit}]")
    for axes, columns in ((above, 3), (below, 3)):
        legend(axes, columns)
    figure.savefig(OUT / "mended_twin.png")


def main() -> None:
    """One strip a task: ``VIEWS`` at four moments. One task's episode as a GIF."""
    for task in tasks_with_expert():
        plan = CollectPlan(task=task, source=ExpertSource())
        sim = plan.make()
        states, counts = episode(sim, plan, seed=1)
        chosen = states[[round(m * (len(states) - 1)) for m in MOMENTS]]
        rows = [[], []]
        for pictures in sim.render_states(chosen, VIEWS, size=SIZE):
            for row, name in zip(rows, VIEWS, strict=True):
                row.append(pictures[name])
        strip = np.concatenate([np.concatenate(row, axis=1) for row in rows])
        path = OUT / f"task_{task}.png"
        cv2.imwrite(str(path), strip[:, :, ::-1])
        print(f"{path}: {sim.task.instruction} ({len(states) / 30:.0f} s, simulated)")
        if task == SHOWN:
            first, *rest = insertion(sim, states, counts)
            times = [100] * len(rest) + [HOLD_MS]
            first.save(
                OUT / "insertion.gif",
                save_all=True,
                append_images=rest,
                duration=times,
                loop=0,
                optimize=True,
            )
        sim.close()
    PAGE.write_text(with_rows(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    mended_twin()


if __name__ == "__main__":
    main()
