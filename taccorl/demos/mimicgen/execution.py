"""Execute a stored demonstration again: compute its rows with touch, and check that it still succeeds.

MuJoCo on another CPU may differ in the last bit, and contact amplifies the difference. So the last state is compared; if it
differs, success and acceptance criteria decide.
"""

from dataclasses import dataclass, field

import numpy as np

from taccorl.data.episode import EXECUTED
from taccorl.data.spec import DatasetSpec
from taccorl.demos.mimicgen.attempt import state_digest
from taccorl.demos.mimicgen.gates import GateKeeper, foreign_contact
from taccorl.demos.mimicgen.spec import GatesSpec
from taccorl.demos.recorder import EpisodeRecorder
from taccorl.sim.simulation import Simulation

DIFFERS = "last_state_differs"
"""Key in an episode's provenance: true if executing its stored actions ended in a different simulator state than the attempt."""
_PAD_NOISE = 2  # with the scene's seed


@dataclass(frozen=True, kw_only=True, eq=False)
class Demonstration:
    """A stored success: scene seed, actions, last state, provenance. Executing it again gives all rows."""

    attempt: int
    """Number of the attempt, from 0."""
    scene_seed: int
    actions: np.ndarray
    """(T, 14) float32 joint targets [rad] and openings [m] as they were executed."""
    intended: np.ndarray | None
    """(T, 14) float32 the dataset's ``action`` if it differs from the executed one; None: equal to ``actions``."""
    last_state: str
    """``state_digest`` after the last action."""
    provenance: dict[str, object] = field(default_factory=dict)


@dataclass(kw_only=True)
class Execution:
    """Result of executing a demonstration again: recorded rows, outcome, and whether the last state is the same."""

    recorder: EpisodeRecorder
    """Recorder with the rows."""
    outcome: str
    """``success``; a failure category of the task; ``not reproduced``; or the acceptance criterion (gate) that was not met."""
    reason: str
    """Explanation of the outcome; empty if there is none."""
    is_same: bool
    """Whether the last state of this execution equals the last state of the stored attempt, bit for bit."""


def execute(sim: Simulation, demonstration: Demonstration, rows: DatasetSpec, gates: GatesSpec) -> Execution:
    """Execute a demonstration in ``sim`` and record its rows.

    Args:
        gates: acceptance criteria for an execution whose last state differs.
    """
    seed, intended = demonstration.scene_seed, demonstration.intended
    if intended is None and EXECUTED in rows.features:
        intended = demonstration.actions
    sim.reset([seed])
    recorder, keeper = EpisodeRecorder(sim, rows, np.random.default_rng([seed, _PAD_NOISE])), GateKeeper(sim)
    for t in range(len(demonstration.actions)):
        recorder.step(demonstration.actions[t], keeper.watch(), None if intended is None else intended[t])
    done = Execution(
        recorder=recorder, outcome="success", reason="", is_same=state_digest(sim) == demonstration.last_state
    )
    if done.is_same:
        return done
    outcome = sim.judge.outcome
    if not outcome.success[0]:
        done.outcome = str(outcome.failure[0]) or "not reproduced"
        done.reason = "executed again, the stored actions end in another state, without success"
    else:
        keeper.see_actions(demonstration.actions)
        states = np.stack([row["sim.state"] for row in recorder.rows])
        done.outcome, done.reason = keeper.measured.refused(gates) or foreign_contact(sim, states) or ("success", "")
    return done
