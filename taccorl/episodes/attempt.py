"""One attempt: a source acts in a simulation; its result, and the files of the result."""

import abc
import json
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Protocol

import draccus
import numpy as np

from taccorl.data.dataset import episode_record
from taccorl.episodes.recorder import EpisodeRecorder
from taccorl.errors import DeadlockError, LostError, UnreachableError
from taccorl.sim.simulation import Simulation, Watch

CAUSES: dict[type[Exception], str] = {
    UnreachableError: "unreachable",
    LostError: "not taken over",
    DeadlockError: "deadlock",
}
"""Error of what acts → outcome of the attempt."""
Entry = dict[str, Any]
"""Content of an attempt's ``entry.json``: outcome, number of rows and others."""


class Targets(NamedTuple):
    """Targets of one control step, (14,) each [rad, m]."""

    sent: np.ndarray
    """What the robot executes: a dataset's ``sim.executed``."""
    intended: np.ndarray | None
    """What a policy is to learn: a dataset's ``action``. It differs from ``sent`` where a demonstrator errs or is disturbed.
    None: it is ``sent``."""


Actions = Iterator[Targets]
"""Targets of one attempt, one per control step."""


@dataclass(frozen=True, kw_only=True)
class Source(draccus.ChoiceRegistry, abc.ABC):
    """Who demonstrates: --source.type=expert or leader."""

    repeatable: ClassVar[bool] = True
    """True if the same seed gives the same actions."""

    @abc.abstractmethod
    def actions(self, sim: Simulation, rng: np.random.Generator) -> Actions:
        """Iterate over the targets of one attempt; the source reads the simulation between them. Ends when the demonstration is
        finished.
        """


class Recorder(Protocol):
    """Interface of what executes targets: ``EpisodeRecorder``, or one that keeps less."""

    def step(
        self,
        action: np.ndarray,
        watch: Watch | None = None,
        intended: np.ndarray | None = None,
    ) -> None:
        """Make one control step with ``action`` (14,)."""
        ...


@dataclass(kw_only=True)
class Attempt:
    """Result of one attempt."""

    outcome: str
    """``success``; a failure category of the task; ``timeout``, ``diverged``; ``unfinished`` (neither success nor failure); one
    of ``CAUSES``; ``error``; ``crashed`` or ``hung`` of its process; or what its kind of attempt adds."""
    reason: str = ""  # Explanation of the outcome; empty if there is none
    name: str = ""
    recorder: EpisodeRecorder | None = (
        None  # Recorder with the rows, if the attempt has rows
    )
    provenance: dict[str, Any] = field(
        default_factory=dict
    )  # How the episode was simulated, for its provenance
    source_digest: str = ""  # Digest of the dataset from which the episode was made
    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    """Name → further array of the attempt, stored as NAME.npy beside entry.json."""
    facts: dict[str, Any] = field(default_factory=dict)  # Further keys of entry.json

    @property
    def rows(self) -> int:
        return len(self.recorder.rows) if self.recorder else 0


def act(
    sim: Simulation,
    targets: Actions,
    recorder: Recorder,
    watch: Callable[[], Watch] | None = None,
) -> tuple[str, str]:
    """Execute ``targets`` up to success, failure, the time limit, or their end. Returns outcome and reason. ``watch``: function
    that returns the callback for the physics steps of the next control step."""
    try:
        for target in targets:
            recorder.step(target.sent, watch() if watch else None, target.intended)
            if sim.judge.outcome.over[0]:
                break
    except tuple(CAUSES) as error:
        return CAUSES[type(error)], str(error)
    return outcome_of(sim), ""


def outcome_of(sim: Simulation) -> str:
    """``success``, the failure's category, or ``unfinished``."""
    outcome = sim.judge.outcome
    return "success" if outcome.success[0] else str(outcome.failure[0]) or "unfinished"


def write_attempt(
    attempt: Callable[[Any, list[Path]], Attempt],
    entry: Callable[[Attempt], Entry],
    keeps: Callable[[Entry], bool],
    counts_errors: bool,
    seconds: dict[str, float],
    config: dict[str, Any],
    inputs: list[Path],
    folder: Path,
) -> None:
    """Stage of an attempt: make it, and write entry.json, its arrays, and of a kept one the rows: dataset/, episodes.json.
    ``counts_errors``: an error is the outcome. ``seconds``: gets part of the work → time it took [s]."""
    try:
        done = attempt(config, inputs)
    except Exception as error:
        if not counts_errors:
            raise
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(place.filename).name}:{place.lineno}"
        done = Attempt(
            outcome="error", reason=f"{type(error).__name__}: {error} ({where})"
        )
    told, began_s = entry(done), time.perf_counter()
    if done.recorder is not None:
        if keeps(told):
            from taccorl.data.lerobot_format import write_episodes

            episode = done.recorder.episode(done.name, done.provenance)
            write_episodes([episode], folder / "dataset")
            write_json(
                folder / "episodes.json", [episode_record(episode, done.source_digest)]
            )
        seconds |= {"physics": done.recorder.physics_s, "touch": done.recorder.touch_s}
        seconds["writing"] = time.perf_counter() - began_s
    for name, array in done.arrays.items():
        np.save(folder / f"{name}.npy", array)
    write_json(folder / "entry.json", told)


def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def write_json(path: Path, value: Any) -> None:
    path.write_text(
        json.dumps(value, indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
    )
