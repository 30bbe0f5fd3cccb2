"""``python -m pipelines.mimicgen_dataset [TASK …] [--episodes=200] [--workers=2] [--images=true]``: a dataset for each task.

20 demonstrations of the scripted expert → ``taccorl augment`` → report. Everything lands in outputs/mimicgen; a run that was
stopped goes on where it was. There is no robot here: all of it comes from the twin, and says so.
"""

import dataclasses
import json
import sys
import time
from pathlib import Path

from pipelines.steps import step
from taccorl.cli import augment, collect
from taccorl.cli.augment import AugmentConfig
from taccorl.cli.collect import CollectConfig
from taccorl.lineage.engines import LocalEngine
from taccorl.tasks.experts import tasks_with_expert

OUT = Path("outputs/mimicgen")
SOURCES = 20
OPTIONS = {"episodes": "200", "workers": "2", "images": "true"}


def make(task: str, options: dict[str, str], out: Path = OUT, sources: int = SOURCES) -> Path:
    """Sources and new episodes of one task; returns the dataset's folder."""
    source, new, store = out / f"{task}_sources", out / task, out / "store"
    # Pictures of the sources are never looked at.
    step(collect.run, CollectConfig(task=task, episodes=sources, images=False, out=source, store=store))
    made = AugmentConfig(source=source, task=task, episodes=int(options["episodes"]), out=new, store=store)
    engine = LocalEngine(workers=int(options["workers"]))
    step(augment.run, dataclasses.replace(made, images=options["images"] == "true", engine=engine))
    return new


def main(words: list[str]) -> None:
    """Words: tasks, all that have an expert by default, and options."""
    tasks = tasks_with_expert()
    options = OPTIONS | dict(word.removeprefix("--").split("=", 1) for word in words if word.startswith("--"))
    named = [word for word in words if not word.startswith("--")] or list(tasks)
    odd = [*(set(options) - set(OPTIONS)), *(set(named) - set(tasks))]
    if odd:
        raise SystemExit(f"no {odd[0]!r}; tasks: {', '.join(tasks)}; options: {', '.join(f'--{o}=' for o in OPTIONS)}")
    lines = []
    for task in named:
        began_s = time.perf_counter()
        new = make(task, options)
        told = json.loads(new.with_name(f"{new.name}.augment_report.json").read_text(encoding="utf-8"))
        share, minutes = told["yield"], (time.perf_counter() - began_s) / 60
        counts = f"{share['successes']} of {share['attempts']} attempts ({100 * share['rate']:.0f} %)"
        lines.append(f"{task:12s}{counts}, {minutes:.0f} min in this run: {new}.augment_report.html")
    print("\n" + "\n".join(lines))


if __name__ == "__main__":
    main(sys.argv[1:])
