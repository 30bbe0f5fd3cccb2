"""What new episodes are made of keeps to what new episodes must keep to: an expert's demonstrations pass the gates themselves."""

from pathlib import Path

import numpy as np
import pytest

from taccorl.data.dataset import Dataset
from taccorl.data.episode import EXECUTED, Episode
from taccorl.episodes.produce import produce
from taccorl.episodes.sources.collect import CollectPlan
from taccorl.episodes.sources.mimicgen.from_dataset import simulation_of
from taccorl.episodes.sources.mimicgen.gates import GateKeeper, Measured, foreign_contact
from taccorl.episodes.sources.mimicgen.spec import load_mimic_spec
from taccorl.lineage.store import Store
from taccorl.sim.simulation import Simulation

NUM_SOURCES = 4  # of each task


def redone(episode: Episode, sim: Simulation) -> tuple[Measured, np.ndarray]:
    """Executed from its stored targets in its scene: what the gates measure, and the states (T, row_size) before each action."""
    sim.reset(episode.arrays["sim.seed"][0])
    gates, states = GateKeeper(sim), []
    executed = episode.arrays.get(EXECUTED, episode.arrays["action"])
    for action in executed:
        states.append(sim.state_rows()[0])
        sim.step(action[None].astype(np.float64), watch=gates.watch())
    gates.see_actions(executed)
    return gates.measured, np.stack(states)


def check(root: Path, task: str) -> None:
    dataset, spec = Dataset(root), load_mimic_spec(task)
    sim = simulation_of(dataset.episode(0), task)
    for i in range(dataset.num_episodes):
        episode = dataset.episode(i)
        measured, states = redone(episode, sim)
        assert np.array_equal(states, episode.arrays["sim.state"]), f"{episode.name} is another one"
        assert sim.judge.outcome.success[0], episode.name
        assert measured.force_n > 0, episode.name  # parts do mate, and the gates saw it
        refused = measured.refused(spec.gates) or foreign_contact(sim, states)
        assert refused is None, (episode.name, refused, measured)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["assembly_1", "assembly_2", "puzzle", "test_tube"])
def test_sources_of_every_task_pass_the_gates(task, tmp_path):
    plan = CollectPlan(task=task, episodes=NUM_SOURCES, images=False)
    produce(plan, tmp_path / "new", Store(tmp_path / "store"), lambda _: None)
    check(tmp_path / "new", task)
