"""Figures of checking and showing an episode; ``make bench ONLY=one_episode``."""

import dataclasses
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pipelines.benchmarks.rows import Row, against_reference, benchmark
from taccorl.lineage.processes import cpu_s
from taccorl.robots import ROBOT

EPISODE_S = 24.0
REPEATS = 5


@benchmark("one_episode")
def one_episode() -> Iterator[Row]:
    """Benchmark of the cost of checking a stand-in episode of 720 rows and of writing it for Rerun."""
    from taccorl.data.checks import check_episode
    from taccorl.data.cutting import open_episodes
    from taccorl.views.episode import save_episode
    from tests.recordings.stand_in import StandInConfig, write_mcap

    with tempfile.TemporaryDirectory(prefix="taccorl_bench_") as name:
        recording, rrd = Path(name) / "recording.mcap", Path(name) / "episode.rrd"
        write_mcap(recording, StandInConfig(duration_s=EPISODE_S, seed=0))
        with open_episodes(recording, "piper_flexitac_mcap") as (episode,):
            what = f"{episode.num_rows} rows with {ROBOT.num_taxels} taxels"
            yield _row(
                f"checks of {what}, without pictures", lambda: check_episode(episode, pictures=False), "≤ 50,000"
            )
            yield _row(f"{what} and three cameras at 224×224 written for Rerun", lambda: save_episode(episode, rrd))
            features = {key: f for key, f in episode.spec.features.items() if key not in episode.picture_keys}
            spec = dataclasses.replace(episode.spec, features=features)
            numbers = dataclasses.replace(episode, spec=spec, picture_keys=(), pictures=lambda: iter(()), videos={})
            yield _row(f"{what} written for Rerun without pictures", lambda: save_episode(numbers, rrd), "≤ 500,000")


def _row(name: str, work: Callable[[], Any], goal: str = "") -> Row:
    work()  # what is imported and compiled at the first call
    costs = []
    for _ in range(REPEATS):
        before = cpu_s(children=True)
        work()
        costs.append(cpu_s(children=True) - before)
    return against_reference(name, costs, goal)
