"""Corrections of a policy (DAgger): it acts, the task's scripted expert takes over, and the expert's rows become a dataset.

    Ross, Gordon, Bagnell 2011 (arXiv:1011.0686); as takeovers: Kelly et al. 2019, HG-DAgger (arXiv:1810.02890)

A policy's episodes come as scene seeds and actions. For each takeover an episode is executed again in one simulation up to its
step, where the state must be the one that the policy was in, bit for bit. The dataset's episode begins with the first row after
the takeover: windows of touch begin there, too, as at the start of any episode. Only successes are kept; everything else is
counted. Letters in shapes: T control steps of the policy's episode.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from taccorl.data.episode import INTENDED
from taccorl.data.origin import TWIN_ORIGIN
from taccorl.data.spec import DatasetSpec
from taccorl.episodes.attempt import Actions, Attempt, Entry, act, read_json, write_json
from taccorl.episodes.plan import Listed, Plan, Step, seed_of
from taccorl.episodes.recorder import EpisodeRecorder
from taccorl.episodes.sources.expert import targets_of
from taccorl.errors import TaccorlError, nearest
from taccorl.lineage.canonical import canonical
from taccorl.lineage.manifest import DATASET_MANIFEST
from taccorl.lineage.stage import Artefact, Stage
from taccorl.lineage.store import Store
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import HOLD_S, tasks
from taccorl.sim.twin import CONTROL_HZ
from taccorl.tasks.experts import expert_of
from taccorl.tasks.experts.hands import ScriptedExpertConfig
from taccorl.tasks.experts.scripted import ScriptedExpert

TAKEOVERS = ("failures", "all")
"""Values of ``CorrectionPlan.takeover``."""
_CORRECTION = Stage("correction", version=6)
_DRAW, _PADS, _EXPERT = (
    1,
    2,
    3,
)  # generators of a takeover: default_rng([scene seed, which, number of the takeover])
_STALL_STEPS = CONTROL_HZ  # 1 s
_STILL = ROBOT.per_action(0.02, 0.001)
"""(A,) [rad, m]: joints and grippers whose range over a second is smaller than this count as still."""


@dataclass(frozen=True)
class PolicyEpisode:
    """Actions of a policy in one scene and the robot's states, up to the end of its episode."""

    seed: int
    outcome: str  # ``success``, or a failure category as in ``taccorl evaluate``
    actions: np.ndarray  # (T, 14) float32 actions as the policy returned them
    states: np.ndarray  # (T + 1, 14) float32 ``observation.state`` before each action, and after the last one
    subtasks: np.ndarray  # (T + 1, 2) int16 index of each arm's subtask, likewise


@dataclass(frozen=True, kw_only=True)
class CorrectionPlan(Plan):
    """Settings of a round of corrections: policy, task, scenes, twin. A correction is an episode that a policy began and the
    task's expert finished.
    """

    policy: str
    """Name of the policy: its checkpoint's folder."""
    policy_digest: str
    """``Checkpoint.digest`` of the policy's files."""
    episodes: int = 128
    """Number of scenes in which the policy acts."""
    episode_length: int | None = None
    """Control steps after which an episode of the policy ends; None: the task's own limit."""
    policy_pictures: str = "clear"
    """How the policy sees the pictures: ``clear``, or ``randomised`` (see taccorl evaluate). Rows have clear pictures."""
    takeover: str = "failures"
    """``failures``: episodes in which the policy succeeds by itself are skipped; ``all``: they are corrected, too."""
    per_episode: int = 1
    """N: number of takeovers of each of the policy's episodes, at drawn times; each is a correction of its own."""
    hands: ScriptedExpertConfig = field(default_factory=ScriptedExpertConfig)
    """Speeds and human-like errors of the expert's hands."""
    before_grasp: bool = False
    """True: takeovers are drawn over the whole episode; False: from the step on in which both parts are held."""
    acted: tuple[Artefact, ...] = ()
    """Batches of the policy's episodes in the scenes ``scene_seeds``: folders of ``write_policy_episodes``."""

    word: ClassVar[str] = "takeover"
    dataset: ClassVar[Stage] = Stage(
        "corrections", version=3, manifest=DATASET_MANIFEST
    )

    def __post_init__(self) -> None:
        """Raises TaccorlError: a setting has an unknown value (the message names the nearest), a number is out of its range, or
        the task's expert cannot take over."""
        task = tasks.get(self.task)(self.difficulty)
        if not expert_of(task).can_resume():
            raise TaccorlError(
                f"--task={self.task}: its expert cannot take over; implement its remaining()"
            )
        if self.takeover not in TAKEOVERS:
            raise TaccorlError(
                f"--takeover={self.takeover}: {nearest(self.takeover, TAKEOVERS)}"
            )
        for name in ("per_episode", "episode_length"):
            if (value := getattr(self, name)) is not None and value < 1:
                raise TaccorlError(f"--{name}={value}: at least 1")
        super().__post_init__()

    @property
    def scene_seeds(self) -> list[int]:
        """Scene seeds of the episodes. They do not depend on the number of episodes, and differ from those of other commands."""
        return [
            seed_of(self.seed, f"correct {self.task}", k) for k in range(self.episodes)
        ]

    def scene_config(self) -> dict[str, Any]:
        """Settings on which the policy's episodes depend, besides the policy and their seeds; part of the store's key."""
        return super().scene_config() | {"episode_length": self.episode_length}

    @property
    def wanted(self) -> int | None:
        return None

    def takeovers(self) -> tuple[list["Takeover"], list[str]]:
        """Takeovers of the episodes in ``acted``, and the policy's outcome in each episode. Episodes in which it succeeds have
        none, unless ``all`` are corrected.
        """
        found, outcomes = list[Takeover](), list[str]()
        for batch in self.acted:
            for index, entry in enumerate(_table(batch.path)):
                if self.takeover == "all" or entry["outcome"] != "success":
                    found += [
                        Takeover(batch, index, len(outcomes), number)
                        for number in range(self.per_episode)
                    ]
                outcomes.append(entry["outcome"])
        return found, outcomes

    def schedule(self, at_once: int) -> Listed:
        return Listed(self.takeovers()[0])

    def config(self, item: "Takeover") -> dict[str, Any]:
        own = {
            "policy_digest": self.policy_digest,
            "before_grasp": self.before_grasp,
            "hands": asdict(self.hands),
        }
        own |= {
            "videos": self.stored_as == "video",
            "part_poses": self.part_poses,
            "origin": TWIN_ORIGIN.text,
        }
        own |= {"root_seed": self.seed, "episode": item.episode, "number": item.number}
        return canonical(self.scene | own)

    def inputs(self, item: "Takeover") -> list[Artefact]:
        return [item.acted]

    @property
    def steps(self) -> tuple[Step, ...]:
        return (Step(_CORRECTION, self._attempt),)

    def _attempt(
        self, item: "Takeover", config: dict[str, Any], inputs: list[Path]
    ) -> Attempt:
        sim, spec, _ = self.opened()
        done = correct_episode(
            self, sim, spec, read_policy_episode(inputs[0], item.index), item.number
        )
        return replace(done, provenance=config | done.provenance)

    def entry(self, item: "Takeover", done: Attempt) -> Entry:
        acted = _table(item.acted.path)[item.index]
        entry = {
            "episode": item.episode,
            "number": item.number,
            "scene_seed": acted["seed"],
        }
        entry |= {
            "policy_outcome": acted["outcome"],
            "policy_steps": acted["steps"],
            "outcome": done.outcome,
        }
        entry |= {
            "reason": done.reason,
            "takeover_step": None,
            "cause": "",
        } | done.facts
        return entry | {"rows": done.rows}

    def dataset_config(self, entries: Sequence[Entry] | None) -> dict[str, Any]:
        own = {
            "policy": self.policy,
            "policy_digest": self.policy_digest,
            "seed": self.seed,
        }
        own |= {
            "per_episode": self.per_episode,
            "before_grasp": self.before_grasp,
            "part_poses": self.part_poses,
        }
        own |= {
            "hands": asdict(self.hands),
            "episodes": self.episodes,
            "takeover": self.takeover,
        }
        return canonical(super().dataset_config(entries) | own | self.kept_pictures)

    def may_be_made_of(
        self, report: dict[str, Any], keys: set[str], store: Store
    ) -> bool:
        return True  # the policy has not acted yet; its digest and the seed state what it does

    def report(self, entries: Sequence[Entry]) -> dict[str, Any]:
        """Counts of outcomes of the policy and the expert, as JSON values."""
        policy, over = (
            self.takeovers()[1],
            [e for e in entries if e["takeover_step"] is not None],
        )
        outcomes = [
            e["outcome"] + (f": {e['reason']}" * (e["outcome"] == "not taken over"))
            for e in entries
        ]
        return super().report(entries) | {
            "policy": self.policy,
            "policy_digest": self.policy_digest,
            "policy_episodes": len(policy),
            "policy_outcomes": dict(Counter(policy).most_common()),
            "policy_successes": policy.count("success"),
            "kept_out": len(policy) - len({e["episode"] for e in entries}),
            "taken_over": len(over),
            "causes": dict(Counter(e["cause"] for e in over).most_common()),
            "outcomes": dict(Counter(outcomes).most_common()),
        }

    def nothing(self, report: dict[str, Any], out: Path) -> TaccorlError:
        own, over = (
            ", ".join(f"{n} {kind}" for kind, n in report[key].items()) or "none"
            for key in ("policy_outcomes", "outcomes")
        )
        return TaccorlError(
            f"{self.task}: no episode was corrected, nothing was written to {out}: the policy's episodes: {own}; takeovers: "
            f"{over}. Give more --episodes, or --takeover=all if the policy succeeds by itself"
        )


@dataclass(frozen=True)
class Takeover:
    """One takeover of one of the policy's episodes."""

    acted: Artefact
    """Batch of the policy's episodes."""
    index: int
    episode: int
    number: int
    """Number of the takeover within the episode, from 0."""

    def __str__(self) -> str:
        return f"{self.episode}.{self.number}"


def write_policy_episodes(episodes: Sequence[PolicyEpisode], folder: Path) -> None:
    """Write the policy's episodes into ``folder``: episodes.json, and the rows of all episodes one after another."""
    table = [
        {"seed": e.seed, "outcome": e.outcome, "steps": len(e.actions)}
        for e in episodes
    ]
    write_json(folder / "episodes.json", table)
    np.save(folder / "actions.npy", np.concatenate([e.actions for e in episodes]))
    np.save(folder / "states.npy", np.concatenate([e.states for e in episodes]))
    np.save(folder / "subtasks.npy", np.concatenate([e.subtasks for e in episodes]))


def read_policy_episode(folder: Path, k: int) -> PolicyEpisode:
    """Read episode ``k`` from the files of ``write_policy_episodes``."""
    table = _table(folder)
    first, steps = sum(e["steps"] for e in table[:k]), table[k]["steps"]
    actions = np.load(folder / "actions.npy", mmap_mode="r")[first : first + steps]
    states, subtasks = (
        np.array(
            np.load(folder / name, mmap_mode="r")[first + k : first + k + steps + 1]
        )
        for name in ("states.npy", "subtasks.npy")
    )
    return PolicyEpisode(
        table[k]["seed"], table[k]["outcome"], np.array(actions), states, subtasks
    )


def _table(folder: Path) -> list[dict[str, Any]]:
    return read_json(folder / "episodes.json")


def correct_episode(
    plan: CorrectionPlan,
    sim: Simulation,
    spec: DatasetSpec,
    episode: PolicyEpisode,
    number: int = 0,
) -> Attempt:
    """Execute the policy's episode up to its takeover ``number``, then let the expert complete the task within the task's full
    time limit.

    Facts of the result: ``takeover_step``, the number of the expert's first action; ``cause``: ``drawn``, ``drawn before the
    grasp`` (the hands do not hold the parts yet), or ``stall``. Neither if the policy's state was not reproduced.
    """
    step, cause = takeover_step(episode, number, before_grasp=plan.before_grasp)
    if not _reproduce(sim, episode, step):
        return Attempt(
            outcome="not reproduced",
            reason="the policy's actions lead to another state",
        )
    sim.judge.restart_clock()
    recorder = EpisodeRecorder(
        sim, spec, np.random.default_rng([episode.seed, _PADS, number])
    )
    expert = expert_of(sim.task)(
        sim, np.random.default_rng([episode.seed, _EXPERT, number]), plan.hands
    )
    outcome, reason = act(sim, _taking_over(expert), recorder)
    facts = {"takeover_step": step, "cause": cause}
    correction = {
        "scene_seed": episode.seed,
        **facts,
        "policy": plan.policy,
        "policy_digest": plan.policy_digest,
    }
    correction |= {
        "policy_outcome": episode.outcome,
        "felt": [list(event) for event in expert.events],
        INTENDED: True,
    }
    return Attempt(
        outcome=outcome,
        reason=reason,
        name=f"{plan.task} seed {episode.seed}, from step {step}",
        recorder=recorder,
        provenance={"correction": correction},
        facts=facts,
    )


def _taking_over(expert: ScriptedExpert) -> Actions:
    expert.resume()
    yield from targets_of(expert)


def takeover_step(
    episode: PolicyEpisode, number: int, *, before_grasp: bool
) -> tuple[int, str]:
    """Step of takeover ``number`` of the policy's episode, and its cause.

    The step is drawn uniformly between the end of each arm's first subtask (both parts are held) and the policy's end, and over
    all of its steps where that never happens, or with ``before_grasp``. Takeover 0 is where the policy stalls, if that is
    earlier; the others are drawn before the stall.
    """
    num, share = (
        len(episode.actions),
        np.random.default_rng([episode.seed, _DRAW, number]).uniform(),
    )
    held = np.flatnonzero((episode.subtasks[:num] >= 1).all(axis=1))
    first = 0 if before_grasp or not held.size else int(held[0])
    stall = first_stall(episode)
    if stall is not None and stall <= first:
        first = 0
    end = num if number == 0 or stall is None else stall
    step = first + int(share * (end - first))
    if number == 0 and stall is not None and stall <= step:
        return stall, "stall"
    return step, "drawn" if (
        episode.subtasks[step] >= 1
    ).all() else "drawn before the grasp"


def _reproduce(sim: Simulation, episode: PolicyEpisode, step: int) -> bool:
    """Execute the policy's first ``step`` actions. False if the state differs from the policy's own."""
    sim.reset([episode.seed])
    limit_steps = sim.judge.limit_steps
    # The policy may have had more time than the task's own (--episode_length); the expert has the task's again.
    sim.judge.limit_steps = max(limit_steps, len(episode.actions) + 1)
    for action in episode.actions[:step]:
        sim.step(action[None].astype(np.float64))
    sim.judge.limit_steps = limit_steps
    state = sim.proprioception()[0].astype(np.float32)
    return np.array_equal(state, episode.states[step]) and not sim.judge.outcome.over[0]


def first_stall(episode: PolicyEpisode) -> int | None:
    """First step in which the policy has stalled (``is_stall``); None if there is none. The rest before a success is none."""
    won = round(HOLD_S * CONTROL_HZ) if episode.outcome == "success" else 0
    for t in range(_STALL_STEPS, len(episode.actions) - won):
        last_s = slice(t - _STALL_STEPS, t + 1)
        if is_stall(episode.states[last_s], episode.subtasks[last_s]):
            return t
    return None


def is_stall(states: np.ndarray, subtasks: np.ndarray) -> bool:
    """Whether the policy has stalled: for one second no joint moved by 0.02 rad, no gripper by 1 mm, and no subtask ended. False
    if less than a second has passed. ``states``: (n, 14), n ≤ 31 rows: joint angles [rad] and openings [m] of the last second.
    ``subtasks``: (n, 2) index of each arm's subtask in these rows."""
    if len(states) <= _STALL_STEPS:
        return False
    return bool(
        (np.ptp(states, axis=0) < _STILL).all() and (subtasks[-1] == subtasks[0]).all()
    )
