"""Corrections of a policy (DAgger): it acts, the task's scripted expert takes over, and the expert's rows become a dataset.

    Ross, Gordon, Bagnell 2011 (arXiv:1011.0686); as takeovers: Kelly et al. 2019, HG-DAgger (arXiv:1810.02890)

A policy's episodes come as scene seeds and actions. For each takeover an episode is executed again in one simulation up to its
step, where the state must be the one that the policy was in, bit for bit. The dataset's episode begins with the first row after
the takeover: windows of touch begin there, too, as at the start of any episode. Only successes are kept; everything else is
counted. Letters in shapes: T control steps of the policy's episode.
"""

import functools
import json
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from taccorl.data.dataset import episode_record
from taccorl.data.episode import INTENDED
from taccorl.data.origin import TWIN_ORIGIN
from taccorl.data.spec import DatasetSpec
from taccorl.demos import attempts
from taccorl.demos.collect import AFTER_S, outcome_of
from taccorl.demos.experts import expert_of
from taccorl.demos.experts.scripted import ScriptedExpertConfig
from taccorl.demos.recorder import EpisodeRecorder
from taccorl.errors import LostError, TaccorlError, UnreachableError, nearest
from taccorl.lineage.canonical import canonical
from taccorl.lineage.engines import Engine, LocalEngine
from taccorl.lineage.processes import Failed
from taccorl.lineage.stage import Artefact, Stage
from taccorl.lineage.store import Store
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import HOLD_S, tasks
from taccorl.sim.twin import CONTROL_HZ

VERSION = 4  # of a takeover's correction
CORRECTIONS_VERSION = 3  # of the dataset
TAKEOVERS = ("failures", "all")
"""Values of ``CorrectionPlan.takeover``."""
_WORD = "correct"  # apart from the scenes of other commands with the same seed
_DRAW, _PADS, _EXPERT = (
    1,
    2,
    3,
)  # generators of a takeover: ``default_rng([scene seed, which, number of the takeover])``
_STALL_STEPS = CONTROL_HZ  # 1 s
_STILL = ROBOT.per_action(0.02, 0.001)
"""(A,) [rad, m]: joints and grippers whose range over a second is smaller than this count as still."""


@dataclass(frozen=True)
class PolicyEpisode:
    """Actions of a policy in one scene and the robot's states, up to the end of its episode."""

    seed: int
    """Scene seed of the episode."""
    outcome: str
    """``success``, or a failure category as in ``taccorl evaluate``."""
    actions: np.ndarray
    """(T, 14) float32 actions as the policy returned them."""
    states: np.ndarray
    """(T + 1, 14) float32 ``observation.state`` before each action, and after the last one."""
    subtasks: np.ndarray
    """(T + 1, 2) int16 index of each arm's subtask, likewise."""


@dataclass(frozen=True, kw_only=True)
class CorrectionPlan(attempts.RowsPlan):
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

    def __post_init__(self) -> None:
        """
        Raises:
            TaccorlError: a setting has an unknown value (the message names the nearest), a number is out of its range, or the
                task's expert cannot take over.
        """
        task = tasks.get(self.task)(self.difficulty)
        if not expert_of(task).can_resume():
            raise TaccorlError(
                f"--task={self.task}: its expert cannot take over within a task; implement its remaining()"
            )
        if self.takeover not in TAKEOVERS:
            raise TaccorlError(f"--takeover={self.takeover}: {nearest(self.takeover, TAKEOVERS)}")
        if self.per_episode < 1:
            raise TaccorlError(f"--per_episode={self.per_episode}: at least 1")
        if self.episode_length is not None and self.episode_length < 1:
            raise TaccorlError(f"--episode_length={self.episode_length}: at least 1")
        super().__post_init__()

    @property
    def scene_seeds(self) -> list[int]:
        """Scene seeds of the episodes. They do not depend on the number of episodes, and differ from those of other commands."""
        return [self._scene_seed(k) for k in range(self.episodes)]

    def _scene_seed(self, k: int) -> int:
        key = (zlib.crc32(f"{_WORD} {self.task}".encode()), k)
        state = np.random.SeedSequence(self.seed, spawn_key=key).generate_state(1, np.uint64)
        return int(state[0] >> np.uint64(2))

    def scene_config(self) -> dict[str, Any]:
        """Settings on which the policy's episodes depend, besides the policy and their seeds; part of the store's key."""
        return super().scene_config() | {"episode_length": self.episode_length}

    def config(self, episode: int, number: int) -> dict[str, Any]:
        """Settings on which takeover ``number`` of an episode depends, besides the policy's episodes, as JSON values; part of the
        store's key.
        """
        own = {
            "policy_digest": self.policy_digest,
            "before_grasp": self.before_grasp,
            "hands": asdict(self.hands),
            "videos": self.stored_as == "video",
            "part_poses": self.part_poses,
            "origin": TWIN_ORIGIN.text,
        }
        return canonical(self.scene_config() | own | {"root_seed": self.seed, "episode": episode, "number": number})


@dataclass(frozen=True)
class Takeover:
    """One takeover of one of the policy's episodes."""

    acted: Artefact
    """Batch of the policy's episodes: a folder of ``write_policy_episodes``."""
    index: int
    """Index of the episode within the batch."""
    episode: int
    """Number of the episode."""
    number: int
    """Number of the takeover within the episode, from 0."""

    def __str__(self) -> str:
        return f"{self.episode}.{self.number}"


def takeovers(plan: CorrectionPlan, acted: Sequence[Artefact]) -> tuple[list[Takeover], list[str]]:
    """Takeovers of the policy's episodes in the batches ``acted``, and the policy's outcome in each episode. Episodes in which it
    succeeds have none, unless the plan corrects ``all``.
    """
    found, outcomes = list[Takeover](), list[str]()
    for batch in acted:
        for index, entry in enumerate(_table(batch.path)):
            if plan.takeover == "all" or entry["outcome"] != "success":
                found += [Takeover(batch, index, len(outcomes), number) for number in range(plan.per_episode)]
            outcomes.append(entry["outcome"])
    return found, outcomes


def write_policy_episodes(episodes: Sequence[PolicyEpisode], folder: Path) -> None:
    """Write the policy's episodes into ``folder``: episodes.json, and the rows of all episodes one after another."""
    table = [{"seed": e.seed, "outcome": e.outcome, "steps": len(e.actions)} for e in episodes]
    attempts.write_json(folder / "episodes.json", table)
    np.save(folder / "actions.npy", np.concatenate([e.actions for e in episodes]))
    np.save(folder / "states.npy", np.concatenate([e.states for e in episodes]))
    np.save(folder / "subtasks.npy", np.concatenate([e.subtasks for e in episodes]))


def read_policy_episode(folder: Path, k: int) -> PolicyEpisode:
    """Read episode ``k`` from the files of ``write_policy_episodes``."""
    table = _table(folder)
    first, steps = sum(e["steps"] for e in table[:k]), table[k]["steps"]
    actions = np.load(folder / "actions.npy", mmap_mode="r")[first : first + steps]
    states, subtasks = (
        np.array(np.load(folder / name, mmap_mode="r")[first + k : first + k + steps + 1])
        for name in ("states.npy", "subtasks.npy")
    )
    return PolicyEpisode(table[k]["seed"], table[k]["outcome"], np.array(actions), states, subtasks)


def _table(folder: Path) -> list[dict[str, Any]]:
    return json.loads((folder / "episodes.json").read_text(encoding="utf-8"))


@dataclass
class Correction:
    """Result of a takeover: outcome, step, recorded rows."""

    outcome: str
    """``success``; ``not taken over``: the expert cannot complete the task from that state; otherwise the expert's failure: the
    task's own category, ``timeout``, ``diverged``, ``unfinished``, ``unreachable``; ``not reproduced``."""
    reason: str = ""
    """Explanation of the outcome; empty if there is none."""
    takeover_step: int | None = None
    """Number of the expert's first action; None if the expert did not act."""
    cause: str = ""
    """Reason for the takeover: ``drawn``, ``drawn before the grasp`` (the hands do not hold the parts yet), or ``stall``."""
    felt: list[tuple[int, str]] = field(default_factory=list)
    """(control step since the takeover, text of the contact that the expert detected and corrected)."""
    recorder: EpisodeRecorder | None = None
    """Recorder with the rows since the takeover; None if there are none."""


def correct_episode(
    plan: CorrectionPlan, sim: Simulation, spec: DatasetSpec, episode: PolicyEpisode, number: int = 0
) -> Correction:
    """Execute the policy's episode up to its takeover ``number``, then let the expert complete the task within the task's full
    time limit.
    """
    step, cause = takeover_step(episode, number, before_grasp=plan.before_grasp)
    if not _reproduce(sim, episode, step):
        return Correction("not reproduced", "the policy's actions lead to another state than the policy was in")
    done = Correction("unfinished", takeover_step=step, cause=cause)
    sim.judge.restart_clock()
    done.recorder = EpisodeRecorder(sim, spec, np.random.default_rng([episode.seed, _PADS, number]))
    expert = expert_of(sim.task)(sim, np.random.default_rng([episode.seed, _EXPERT, number]), plan.hands)
    try:
        expert.resume()
        after = 0
        while after < round(AFTER_S * CONTROL_HZ) and not sim.judge.outcome.over[0]:
            action = expert.act()
            done.recorder.step(action, intended=expert.intended(action))
            after += expert.done
        done.outcome = outcome_of(sim)
    except LostError as error:
        done.outcome, done.reason = "not taken over", str(error)
    except UnreachableError as error:
        done.outcome, done.reason = "unreachable", str(error)
    done.felt = expert.events
    return done


def takeover_step(episode: PolicyEpisode, number: int, *, before_grasp: bool) -> tuple[int, str]:
    """Step of takeover ``number`` of the policy's episode, and its cause.

    The step is drawn uniformly between the end of each arm's first subtask (both parts are held) and the policy's end, and over
    all of its steps where that never happens, or with ``before_grasp``. Takeover 0 is where the policy stalls, if that is
    earlier; the others are drawn before the stall.
    """
    num, share = len(episode.actions), np.random.default_rng([episode.seed, _DRAW, number]).uniform()
    held = np.flatnonzero((episode.subtasks[:num] >= 1).all(axis=1))
    first = 0 if before_grasp or not held.size else int(held[0])
    stall = first_stall(episode)
    if stall is not None and stall <= first:
        first = 0
    end = num if number == 0 or stall is None else stall
    step = first + int(share * (end - first))
    if number == 0 and stall is not None and stall <= step:
        return stall, "stall"
    return step, "drawn" if (episode.subtasks[step] >= 1).all() else "drawn before the grasp"


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
    if less than a second has passed.

    Args:
        states: (n, 14), n ≤ 31 rows: joint angles [rad] and openings [m] of the last second.
        subtasks: (n, 2) index of each arm's subtask in these rows.
    """
    if len(states) <= _STALL_STEPS:
        return False
    return bool((np.ptp(states, axis=0) < _STILL).all() and (subtasks[-1] == subtasks[0]).all())


def correct(
    plan: CorrectionPlan,
    acted: Sequence[Artefact],
    out: Path,
    store: Store,
    engine: Engine | None = None,
    progress: attempts.Progress = print,
) -> dict[str, Any]:
    """Correct the policy's episodes and write the expert's rows as a LeRobot dataset at ``out``; returns the report.

    Args:
        acted: folders of ``write_policy_episodes``, in which there are ``plan.episodes`` episodes, whose seeds are
            ``plan.scene_seeds``.

    Raises:
        InTheWayError: ``out`` holds something else.
        TaccorlError: no takeover succeeded; nothing is written.
    """
    sim = plan.make()
    spec = plan.published(sim)
    attempts.compile_touch(sim)
    sim.close()
    items, policy_outcomes = takeovers(plan, acted)
    made = attempts.run_attempts(
        functools.partial(run_correction, plan, store),
        items,
        engine or LocalEngine(),
        said=lambda entry: entry["outcome"] + (f", {entry['reason']}" if entry["reason"] else ""),
        progress=progress,
        name="takeover",
    )
    report = correction_report(plan, policy_outcomes, [entry for _, entry in made])
    if not (kept := [artefact for artefact, entry in made if attempts.is_success(entry)]):
        raise TaccorlError(
            f"{plan.task}: no episode was corrected, nothing was written to {out}: the policy's episodes: "
            f"{report['policy_outcomes']}, takeovers: {report['outcomes']}. Give more --episodes, or --takeover=all if the "
            "policy succeeds by itself"
        )

    def write(_: Any, inputs: list[Path], folder: Path) -> None:
        attempts.assemble(spec, report, inputs, folder, rows_per_picture=plan.cached_rows, engine=engine)

    store.run(_CORRECTIONS.bound(write), _dataset_config(plan), kept, destination=out)
    return report


def _dataset_config(plan: CorrectionPlan) -> dict[str, Any]:
    own = {"task": plan.task, "policy": plan.policy, "policy_digest": plan.policy_digest, "seed": plan.seed}
    own |= {"per_episode": plan.per_episode, "before_grasp": plan.before_grasp, "part_poses": plan.part_poses}
    own |= {"hands": asdict(plan.hands)}
    return canonical(own | plan.kept_pictures | {"episodes": plan.episodes, "takeover": plan.takeover})


def check_out(plan: CorrectionPlan, out: Path) -> None:
    """Fail before the policy acts if the dataset cannot be written to ``out``.

    Raises:
        InTheWayError: something else is there; the message states what.
    """
    attempts.check_destination(
        out, _CORRECTIONS, plan.task, lambda manifest: manifest["config"] == _dataset_config(plan)
    )


def run_correction(plan: CorrectionPlan, store: Store, item: Takeover, end: Failed | None = None) -> Artefact:
    """Make one correction, unless the store has the result. The artefact holds entry.json, for a success also dataset/ and
    episodes.json.

    Args:
        end: the way its process ended, if it died or was stopped; it is then the outcome.
    """

    def build(config: Any, inputs: list[Path], folder: Path) -> None:
        episode = read_policy_episode(inputs[0], item.index)
        if end is None:
            _build(plan, item, config, episode, folder)
        else:
            _write_entry(Correction(end.process, end.reason), episode, item, folder)

    return store.run(_CORRECTION.bound(build), plan.config(item.episode, item.number), [item.acted])


_CORRECTION = Stage("correction", version=VERSION)
_CORRECTIONS = Stage("corrections", version=CORRECTIONS_VERSION, manifest=attempts.DATASET_MANIFEST)


def _build(plan: CorrectionPlan, item: Takeover, config: dict[str, Any], episode: PolicyEpisode, folder: Path) -> None:
    from taccorl.data.lerobot_format import write_episodes

    sim, spec = _simulation(plan)
    done = correct_episode(plan, sim, spec, episode, item.number)
    correction = {
        "scene_seed": episode.seed,
        "takeover_step": done.takeover_step,
        "cause": done.cause,
        "policy": plan.policy,
        "policy_digest": plan.policy_digest,
        "policy_outcome": episode.outcome,
        "felt": [list(event) for event in done.felt],
        INTENDED: True,
    }
    if done.outcome == "success" and done.recorder is not None:
        name = f"{plan.task} seed {episode.seed}, from step {done.takeover_step}"
        made = done.recorder.episode(name, config | {"correction": correction})
        write_episodes([made], folder / "dataset")
        attempts.write_json(folder / "episodes.json", [episode_record(made, "")])
    _write_entry(done, episode, item, folder)


def _write_entry(done: Correction, episode: PolicyEpisode, item: Takeover, folder: Path) -> None:
    """What every correction leaves."""
    entry = {
        "episode": item.episode,
        "number": item.number,
        "scene_seed": episode.seed,
        "policy_outcome": episode.outcome,
        "policy_steps": len(episode.actions),
        "outcome": done.outcome,
        "reason": done.reason,
        "takeover_step": done.takeover_step,
        "cause": done.cause,
        "rows": len(done.recorder.rows) if done.recorder else 0,
    }
    attempts.write_json(folder / "entry.json", entry)


def _simulation(plan: CorrectionPlan) -> tuple[Simulation, DatasetSpec]:
    """Made once in a process."""

    def make() -> tuple[Simulation, DatasetSpec]:
        sim = plan.make()
        return sim, plan.contract(sim)

    return attempts.made_once(["correction", plan.config(0, 0)], make)


def correction_report(
    plan: CorrectionPlan, policy_outcomes: Sequence[str], entries: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """Counts of outcomes of the policy and the expert, as JSON values.

    Args:
        policy_outcomes: outcome of each of the policy's episodes.
        entries: content of the entry.json of each takeover.
    """

    def count(values: Sequence[str]) -> dict[str, int]:
        return dict(Counter(values).most_common())

    over = [e for e in entries if e["takeover_step"] is not None]
    return {
        "task": plan.task,
        **TWIN_ORIGIN.record(),
        "policy": plan.policy,
        "policy_digest": plan.policy_digest,
        "policy_episodes": len(policy_outcomes),
        "policy_outcomes": count(policy_outcomes),
        "policy_successes": sum(outcome == "success" for outcome in policy_outcomes),
        "kept_out": len(policy_outcomes) - len({e["episode"] for e in entries}),
        "attempts": len(entries),
        "taken_over": len(over),
        "causes": count([e["cause"] for e in over]),
        "outcomes": count([e["outcome"] + (f": {e['reason']}" * (e["outcome"] == "not taken over")) for e in entries]),
        "episodes": attempts.successes(entries),
        "rows": sum(e["rows"] for e in entries if attempts.is_success(e)),
        "entries": list(entries),
    }
