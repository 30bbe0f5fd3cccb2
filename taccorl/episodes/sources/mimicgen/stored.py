"""Demonstration of MimicGen as seed and actions, 24 kB, and its execution: the same simulation again, which gives all rows."""

import hashlib
import itertools
from dataclasses import dataclass, field

import numpy as np

from taccorl.data.episode import EXECUTED
from taccorl.data.spec import DatasetSpec
from taccorl.episodes.attempt import Attempt, Targets, act
from taccorl.episodes.recorder import EpisodeRecorder
from taccorl.episodes.sources.mimicgen.gates import GateKeeper, foreign_contact
from taccorl.episodes.sources.mimicgen.spec import GatesSpec
from taccorl.sim.simulation import Simulation

MIMICGEN = "mimicgen"
"""Key of an episode's provenance that states how it was generated."""
DIFFERS = "last_state_differs"
"""Key in it: true if executing the stored actions ended in a different simulator state than the attempt."""
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


def execute(
    sim: Simulation, demonstration: Demonstration, rows: DatasetSpec, gates: GatesSpec
) -> Attempt:
    """Execute a demonstration again and record its rows. Facts of the result: ``differs``, whether its last state is another one.

    MuJoCo on another CPU may differ in the last bit, and contact amplifies the difference: then success and the acceptance
    criteria ``gates`` decide. Outcomes: ``success``; a failure category of the task; ``not reproduced``; a criterion (gate) that
    was not met.
    """
    seed, actions, intended = (
        demonstration.scene_seed,
        demonstration.actions,
        demonstration.intended,
    )
    if intended is None and EXECUTED in rows.features:
        intended = actions
    sim.reset([seed])
    recorder, keeper = (
        EpisodeRecorder(sim, rows, np.random.default_rng([seed, _PAD_NOISE])),
        GateKeeper(sim),
    )
    labels = intended if intended is not None else itertools.repeat(None)
    outcome, reason = act(sim, map(Targets, actions, labels), recorder, keeper.watch)
    differs = state_digest(sim) != demonstration.last_state
    if not differs:
        outcome, reason = "success", ""  # as it was judged when it was made
    elif outcome != "success":
        outcome = "not reproduced" if outcome == "unfinished" else outcome
        reason = (
            "executed again, the stored actions end in another state, without success"
        )
    else:
        keeper.see_actions(actions)
        states = np.stack([row["sim.state"] for row in recorder.rows])
        outcome, reason = (
            keeper.measured.refused(gates)
            or foreign_contact(sim, states)
            or ("success", "")
        )
    made = demonstration.provenance | ({DIFFERS: True} if differs else {})
    return Attempt(
        outcome=outcome,
        reason=reason,
        name=f"{sim.task.name} attempt {demonstration.attempt}",
        recorder=recorder,
        provenance={MIMICGEN: made},
        facts={"differs": differs},
    )


def state_digest(sim: Simulation) -> str:
    """SHA-256 (64 hexadecimal digits) of the state row of simulation 0, bit for bit."""
    return hashlib.sha256(
        np.ascontiguousarray(sim.state_rows()[0]).tobytes()
    ).hexdigest()
