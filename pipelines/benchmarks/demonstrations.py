"""Figures of the twin's experts and of MimicGen: ``make bench ONLY=experts``, ``mimicgen_cost``, ``mimicgen_TASK``."""

import dataclasses
import functools
import math
import tempfile
from collections.abc import Iterator
from pathlib import Path
from statistics import mean, median
from typing import Any

from pipelines.benchmarks.expert_score import score_expert
from pipelines.benchmarks.generation_score import score_generation, stiffened
from pipelines.benchmarks.rows import Row, against_reference, benchmark, spread
from taccorl.episodes.produce import produce
from taccorl.episodes.sources.collect import CollectPlan
from taccorl.episodes.sources.mimicgen.from_dataset import read_sources
from taccorl.episodes.sources.mimicgen.spec import (
    NoiseSpec,
    load_mimic_spec,
    with_options,
)
from taccorl.evaluation.statistics import wilson_interval
from taccorl.lineage.store import Store
from taccorl.sim.twin import TwinConfig
from taccorl.tasks.experts import tasks_with_expert

EXPERT_EPISODES = 100
PENETRATION_EPISODES = 20
MIMICGEN_ATTEMPTS = 100
MIMICGEN_SOURCES = 20
COST_ATTEMPTS, COST_SOURCES = 20, 5


@benchmark("experts")
def expert_rows() -> Iterator[Row]:
    """Benchmark of the experts of all tasks under the paper's randomisation. Simulated."""
    for task in tasks_with_expert():
        score = score_expert(task, EXPERT_EPISODES)
        n = len(score.outcomes)
        rate = score.success_rate
        failures = (
            ", ".join(f"{count} {name}" for name, count in score.failures.items())
            or "no failures"
        )
        name, spread_pc = (
            f"{task}: success, {failures}",
            100 * (rate * (1 - rate) / n) ** 0.5,
        )
        yield Row(
            name=name, value=100 * rate, unit="%", goal="≥ 90", n=n, spread=spread_pc
        )
        yield against_reference(
            f"{task}: cost of an episode of {mean(score.duration_s):.1f} s with {mean(score.corrections):.1f} "
            "corrections, without pictures",
            score.cpu_s,
            "≤ 200,000",
        )
        fine = score_expert(task, PENETRATION_EPISODES, seed=1, every_step=True)
        deepest = [1e3 * d for d in fine.penetration_m]
        yield Row.of(
            deepest,
            by=max,
            name=f"{task}: deepest penetration of mating parts at any physics step, clearance 0.5 mm "
            f"(median episode {median(deepest):.2f} mm, largest force {max(fine.force_n):.0f} N)",
            unit="mm",
            goal="≤ 0.2",
        )


def _mimicgen_sources(task: str, num_sources: int) -> Any:
    """Demonstrations of the expert in the nominal twin, read back from the dataset that ``taccorl collect`` makes of them."""
    with tempfile.TemporaryDirectory(prefix="taccorl_bench_") as name:
        plan = CollectPlan(task=task, episodes=num_sources, images=False)
        produce(
            plan, Path(name) / "sources", Store(Path(name) / "store"), lambda _: None
        )
        return read_sources(Path(name) / "sources", load_mimic_spec(task))


@benchmark("mimicgen_cost")
def mimicgen_cost() -> Iterator[Row]:
    """Benchmark of MimicGen's cost of physics per kept episode, relative to the expert's own episodes in the same run.
    Simulated."""
    for task in tasks_with_expert():
        made = score_generation(
            load_mimic_spec(task),
            _mimicgen_sources(task, COST_SOURCES),
            TwinConfig(),
            COST_ATTEMPTS,
        )
        shown = score_expert(task, COST_ATTEMPTS)
        name = f"{task}: physics, failed attempts too, for 15 s of kept episodes of {mean(made.duration_s):.1f} s"
        whole = 15.0 * sum(made.cpu_s) / sum(made.duration_s)
        row = against_reference(name, [whole], "≤ 150,000")
        yield dataclasses.replace(
            row, n=COST_ATTEMPTS, spread=row.value * spread(made.cpu_s) / whole
        )
        yield against_reference(
            f"{task}: the expert, for 15 s",
            [15.0 * sum(shown.cpu_s) / sum(shown.duration_s)],
        )


def mimicgen_cells(task: str) -> Iterator[Row]:
    """Benchmark of the yield of generation on a task, relative to that of the original MimicGen, which replays commanded
    end-effector poses. Each cell has ``MIMICGEN_ATTEMPTS`` attempts in the same scenes, with sources from the nominal twin.
    Simulated.
    """
    ours, twin = load_mimic_spec(task), TwinConfig()
    sources, num_attempts = _mimicgen_sources(task, MIMICGEN_SOURCES), MIMICGEN_ATTEMPTS
    plain = score_generation(ours, sources, twin, num_attempts, check=True)
    yield _yield_row("yield", plain, "≥ 80")
    yield Row(
        name="kept episodes that are broken at the last frame or not reproduced from their own actions",
        value=plain.broken + plain.outcomes.count("not reproduced"), unit="episodes", goal="≤ 0", n=len(plain.duration_s),
        spread=0.0,
    )  # fmt: skip
    noise = NoiseSpec(position_m=0.0025, rotation_rad=math.radians(1.4))
    cells = (
        (
            "MimicGen's noise of 2.5 mm and 1.4° a step in transport",
            with_options(ours, noise=noise),
            twin,
            "≥ 70",
            "",
        ),
        ("stiffness halved", ours, stiffened(twin, 0.5), "≥ 75", "≤ 30"),
        ("stiffness doubled", ours, stiffened(twin, 2.0), "≥ 75", "≤ 30"),
    )
    for words, spec, place, goal, replay_goal in cells:
        held = score_generation(spec, sources, place, num_attempts)
        replay = score_generation(
            with_options(spec, retarget="eef_command"), sources, place, num_attempts
        )
        yield _yield_row(f"yield, {words}", held, goal)
        yield _yield_row(
            f"yield of replayed end-effector poses, {words}", replay, replay_goal
        )
        if place is twin:
            yield Row(
                name=f"yield over that of replayed poses (its 0 counts as 1), {words}",
                value=held.outcomes.count("success") / max(replay.outcomes.count("success"), 1),
                unit="×", goal="≥ 3", n=num_attempts, spread=0.0,
            )  # fmt: skip


def _yield_row(name: str, score: Any, goal: str) -> Row:
    """Value and 95 % interval (Wilson) of a yield."""
    done, n = score.outcomes.count("success"), len(score.outcomes)
    low, high = wilson_interval(done, n)
    failures = (
        ", ".join(f"{count} {what}" for what, count in score.failures.items())
        or "no failures"
    )
    return Row(
        name=f"{name} (95 %: {100 * low:.0f} … {100 * high:.0f}); {failures}",
        value=100 * done / n, unit="%", goal=goal, n=n, spread=50 * (high - low),
    )  # fmt: skip


for _task in tasks_with_expert():  # one by one: each takes half an hour
    benchmark(f"mimicgen_{_task}")(functools.partial(mimicgen_cells, _task))
