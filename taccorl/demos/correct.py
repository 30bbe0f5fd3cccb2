"""Corrections of a policy (DAgger): it acts, the task's scripted expert takes over, and the expert's rows become a dataset.

    Ross, Gordon, Bagnell 2011 (arXiv:1011.0686); as takeovers: Kelly et al. 2019, HG-DAgger (arXiv:1810.02890)

A policy's episodes come as scene seeds and actions. Each is executed again in one simulation up to the takeover, where the
state must be the one that the policy was in, bit for bit. The dataset's episode begins with the first row after the takeover:
windows of touch begin there, too, as at the start of any episode. Only successes are kept; everything else is counted.
Letters in shapes: T control steps of the policy's episode.
"""

import dataclasses
import functools
import json
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from taccorl.data.dataset import episode_record
from taccorl.data.episode import EXECUTED, INTENDED
from taccorl.data.origin import TWIN_ORIGIN
from taccorl.data.spec import DatasetSpec
from taccorl.demos import attempts
from taccorl.demos.collect import AFTER_S, outcome_of
from taccorl.demos.experts import expert_of
from taccorl.demos.mimicgen.attempt import state_digest
from taccorl.demos.mimicgen.execution import Demonstration
from taccorl.demos.mimicgen.spec import GatesSpec
from taccorl.demos.mimicgen.stored_actions import CORRECTION, write_stored
from taccorl.demos.recorder import EpisodeRecorder, row_spec
from taccorl.errors import LostError, TaccorlError, UnreachableError, nearest
from taccorl.lineage.canonical import canonical
from taccorl.lineage.engines import Engine, LocalEngine
from taccorl.lineage.processes import Failed
from taccorl.lineage.stage import Artefact, Stage
from taccorl.lineage.store import Store
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.sim.twin import CONTROL_HZ

VERSION = 3  # of an episode's correction
CORRECTIONS_VERSION = 2  # of the dataset
TAKEOVERS = ("failures", "all")
"""Values of ``CorrectionPlan.takeover``."""
ROWS = ("dataset", "actions")
"""Values of ``CorrectionPlan.rows``."""
KEPT_OUT = "policy succeeded"
"""Outcome of an episode that the policy completed itself, so that nothing was corrected."""
_WORD = "correct"  # apart from the scenes of other commands with the same seed
_DRAW, _PADS, _EXPERT = 1, 2, 3  # generators of an episode: ``default_rng([scene seed, which])``
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


@dataclass(frozen=True, kw_only=True)
class CorrectionPlan(attempts.AttemptPlan):
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
    pictures: str = "clear"
    """How the policy sees the pictures: ``clear``, or ``randomised`` (see taccorl evaluate). Rows have clear pictures."""
    takeover: str = "failures"
    """``failures``: episodes in which the policy succeeds by itself are skipped; ``all``: they are corrected, too."""
    rows: str = "dataset"
    """Kind of output. ``dataset``: a LeRobot dataset. ``actions``: seeds and actions, from which ``taccorl execute`` makes a
    dataset, also together with other stored actions."""
    part_poses: bool = False
    """True: rows hold the poses of the task's parts (``observation.environment_state``)."""

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
        if self.rows not in ROWS:
            raise TaccorlError(f"--rows={self.rows}: {nearest(self.rows, ROWS)}")
        if self.rows == "actions" and self.part_poses:
            raise TaccorlError("--part_poses=true has no effect with --rows=actions: give it to taccorl execute")
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

    def contract(self, sim: Simulation) -> DatasetSpec:
        """Data spec of the rows of the dataset that ``correct`` writes."""
        return row_spec(sim, pictures=self.images, executed=True, parts=self.part_poses)

    def scene_config(self) -> dict[str, Any]:
        """Settings on which the policy's episodes depend, besides the policy and their seeds; part of the store's key."""
        return super().scene_config() | {"episode_length": self.episode_length}

    def config(self, k: int) -> dict[str, Any]:
        """Settings on which the correction of episode ``k`` depends, besides the policy's episodes, as JSON values; part of the
        store's key.
        """
        own = {
            "policy_digest": self.policy_digest,
            "takeover": self.takeover,
            "images": self.images,
            "origin": TWIN_ORIGIN.text,
        }
        own |= {"part_poses": True} if self.part_poses else {}
        own |= {"rows": self.rows} if self.rows == "actions" else {}
        return canonical(self.scene_config() | own | {"root_seed": self.seed, "episode": k})


def write_policy_episodes(episodes: Sequence[PolicyEpisode], folder: Path) -> None:
    """Write the policy's episodes into ``folder``: episodes.json, and the rows of all episodes one after another."""
    table = [{"seed": e.seed, "outcome": e.outcome, "steps": len(e.actions)} for e in episodes]
    attempts.write_json(folder / "episodes.json", table)
    np.save(folder / "actions.npy", np.concatenate([e.actions for e in episodes]))
    np.save(folder / "states.npy", np.concatenate([e.states for e in episodes]))


def read_policy_episode(folder: Path, k: int) -> PolicyEpisode:
    """Read episode ``k`` from the files of ``write_policy_episodes``."""
    table = json.loads((folder / "episodes.json").read_text(encoding="utf-8"))
    first, steps = sum(e["steps"] for e in table[:k]), table[k]["steps"]
    actions = np.load(folder / "actions.npy", mmap_mode="r")[first : first + steps]
    states = np.load(folder / "states.npy", mmap_mode="r")[first + k : first + k + steps + 1]
    return PolicyEpisode(table[k]["seed"], table[k]["outcome"], np.array(actions), np.array(states))


@dataclass
class Correction:
    """Result of correcting one of the policy's episodes: outcome, takeover, executed actions, recorded rows."""

    outcome: str
    """``success``; ``policy succeeded``: nothing to correct; ``not taken over``: the expert cannot complete the task from that
    state; otherwise the expert's failure: the task's own category, ``timeout``, ``diverged``, ``unfinished``, ``unreachable``;
    ``not reproduced``."""
    reason: str = ""
    """Explanation of the outcome; empty if there is none."""
    takeover_step: int | None = None
    """Number of the expert's first action; None if the expert did not act."""
    cause: str = ""
    """Reason for the takeover: ``drawn``, ``stall``, or ``drawn before the grasp`` (the hands never held the parts)."""
    actions: np.ndarray = field(default_factory=lambda: np.zeros((0, ROBOT.num_actions), np.float32))
    """(S, 14) float32 all actions executed since the reset: the policy's, then the expert's."""
    intended: np.ndarray = field(default_factory=lambda: np.zeros((0, ROBOT.num_actions), np.float32))
    """(S, 14) float32 the same without the expert's aiming error and tremor: the dataset's ``action``."""
    last_state: str = ""
    """``state_digest`` after the last action."""
    felt: list[tuple[int, str]] = field(default_factory=list)
    """(control step since the takeover, text of the contact that the expert detected and corrected)."""
    recorder: EpisodeRecorder | None = None
    """Recorder with the rows since the takeover; None if there are none."""


def correct_episode(plan: CorrectionPlan, sim: Simulation, spec: DatasetSpec, episode: PolicyEpisode) -> Correction:
    """Execute the policy's episode up to the takeover, then let the expert complete the task within the task's full time
    limit."""
    if episode.outcome == "success" and plan.takeover == "failures":
        return Correction(KEPT_OUT)
    limit_steps = sim.judge.limit_steps
    takeover = _execute_until_takeover(sim, episode)  # as ``execution.act_out`` does, which executes it again
    sim.judge.limit_steps = limit_steps
    if takeover is None:
        return Correction("not reproduced", "the policy's actions lead to another state than the policy was in")
    step, cause = takeover
    done = Correction("unfinished", takeover_step=step, cause=cause)
    sim.judge.restart_clock()
    done.recorder = EpisodeRecorder(sim, spec, np.random.default_rng([episode.seed, _PADS]))
    expert = expert_of(sim.task)(sim, np.random.default_rng([episode.seed, _EXPERT]))
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
    done.actions, done.intended = (
        np.concatenate([episode.actions[:step], *(row[key][None] for row in done.recorder.rows)])
        for key in (EXECUTED, "action")
    )
    done.felt = expert.events
    done.last_state = state_digest(sim)
    return done


def _execute_until_takeover(sim: Simulation, episode: PolicyEpisode) -> tuple[int, str] | None:
    """Reset the simulation and execute the policy's actions. Return the step of the takeover and its cause; None if the policy's
    states are not reproduced.

    The step is drawn uniformly between the end of each arm's first subtask (both parts are held) and the policy's end, and over
    all of its steps where that never happens. A stall is an earlier takeover.
    """
    share, num = np.random.default_rng([episode.seed, _DRAW]).uniform(), len(episode.actions)
    drawn, early, subtasks = None, int(share * num), []
    sim.reset([episode.seed])
    snapshot = sim.snapshot()
    # The policy may have had more time than the task's own (--episode_length); the expert has the task's again.
    sim.judge.limit_steps = max(sim.judge.limit_steps, num + 1)
    for t in range(num):
        if sim.judge.outcome.over[0]:
            return None
        subtasks.append(sim.judge.subtask[0].copy())
        if drawn is None and (subtasks[t] >= 1).all():
            drawn = t + int(share * (num - t))
        last_s = slice(max(t - _STALL_STEPS, 0), t + 1)
        if is_stall(episode.states[last_s], np.array(subtasks[last_s])) and not sim.judge.held[0]:
            return _reproduced(sim, episode, t, "stall")
        if t == drawn:
            return _reproduced(sim, episode, t, "drawn")
        if t == early:
            snapshot = sim.snapshot()
        sim.step(episode.actions[[t]].astype(np.float64))
    sim.restore(snapshot)
    return _reproduced(sim, episode, early, "drawn before the grasp")


def _reproduced(sim: Simulation, episode: PolicyEpisode, t: int, cause: str) -> tuple[int, str] | None:
    state = sim.proprioception()[0].astype(np.float32)
    return (t, cause) if np.array_equal(state, episode.states[t]) else None


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
    acted: Artefact,
    out: Path,
    store: Store,
    engine: Engine | None = None,
    progress: attempts.Progress = print,
) -> dict[str, Any]:
    """Correct the policy's episodes ``acted`` and write the expert's rows as a LeRobot dataset at ``out``; returns the report.

    Args:
        acted: folder of ``write_policy_episodes`` with ``plan.episodes`` episodes, whose seeds are ``plan.scene_seeds``.

    Raises:
        InTheWayError: ``out`` holds something else.
        TaccorlError: no takeover succeeded; nothing is written.
    """
    sim = plan.make()
    spec = plan.contract(sim)
    sim.close()

    made = attempts.run_attempts(
        functools.partial(run_correction, plan, acted, store),
        range(plan.episodes),
        engine or LocalEngine(),
        said=lambda entry: entry["outcome"] + (f", {entry['reason']}" if entry["reason"] else ""),
        progress=progress,
        name="episode",
    )
    report = correction_report(plan, [entry for _, entry in made])
    if not (kept := [artefact for artefact, entry in made if attempts.is_success(entry)]):
        raise TaccorlError(
            f"{plan.task}: no episode was corrected, nothing was written to {out}: {report['outcomes']}. Give more --episodes, "
            "or --takeover=all if the policy succeeds by itself"
        )

    def write(_: Any, inputs: list[Path], folder: Path) -> None:
        if plan.rows == "dataset":
            attempts.assemble(spec, report, inputs, folder)
        else:
            simulation = plan.config(0) | {"sources": ""}
            gates = {"gates": dataclasses.asdict(GatesSpec())}
            write_stored(folder, simulation, gates, report, [_demonstration(path) for path in inputs], CORRECTION)

    store.run(_stage(plan).bound(write), _dataset_config(plan), kept, destination=out)
    return report


def _demonstration(folder: Path) -> Demonstration:
    """A success as it is stored."""
    entry = attempts.read_entry(folder)
    return Demonstration(
        attempt=entry["episode"],
        scene_seed=entry["scene_seed"],
        actions=np.load(folder / "actions.npy"),
        intended=np.load(folder / "intended.npy"),
        last_state=entry["last_state"],
        provenance=entry["correction"],
        first_row=entry["takeover_step"],
    )


def _stage(plan: CorrectionPlan) -> Stage:
    return _CORRECTIONS if plan.rows == "dataset" else _CORRECTION_ACTIONS


def _dataset_config(plan: CorrectionPlan) -> dict[str, Any]:
    own = {"task": plan.task, "policy": plan.policy, "policy_digest": plan.policy_digest, "seed": plan.seed}
    own |= {"part_poses": True} if plan.part_poses else {}
    return canonical(own | {"episodes": plan.episodes, "takeover": plan.takeover})


def check_out(plan: CorrectionPlan, out: Path) -> None:
    """Fail before the policy acts if the dataset cannot be written to ``out``.

    Raises:
        InTheWayError: something else is there; the message states what.
    """
    attempts.check_destination(
        out, _stage(plan), plan.task, lambda manifest: manifest["config"] == _dataset_config(plan)
    )


def run_correction(plan: CorrectionPlan, acted: Artefact, store: Store, k: int, end: Failed | None = None) -> Artefact:
    """Correct episode ``k``, unless the store has the result. The artefact holds entry.json, actions.npy and intended.npy, for a
    success also dataset/ and episodes.json.

    Args:
        end: the way its process ended, if it died or was stopped; it is then the outcome.
    """

    def build(config: Any, inputs: list[Path], folder: Path) -> None:
        if end is None:
            _build(plan, k, config, inputs[0], folder)
        else:
            _write(Correction(end.process, end.reason), read_policy_episode(inputs[0], k), k, folder)

    return store.run(_CORRECTION.bound(build), plan.config(k), [acted])


_CORRECTION = Stage("correction", version=VERSION)
_CORRECTIONS = Stage("corrections", version=CORRECTIONS_VERSION, manifest=attempts.DATASET_MANIFEST)
_CORRECTION_ACTIONS = Stage("correction_actions", version=CORRECTIONS_VERSION)


def _build(plan: CorrectionPlan, k: int, config: dict[str, Any], acted: Path, folder: Path) -> None:
    from taccorl.data.lerobot_format import write_episodes

    episode, (sim, spec) = read_policy_episode(acted, k), _simulation(plan)
    done = correct_episode(plan, sim, spec, episode)
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
    if done.outcome == "success" and done.recorder is not None and plan.rows == "dataset":
        name = f"{plan.task} seed {episode.seed}, from step {done.takeover_step}"
        made = done.recorder.episode(name, config | {"correction": correction})
        write_episodes([made], folder / "dataset")
        attempts.write_json(folder / "episodes.json", [episode_record(made, "")])
    _write(done, episode, k, folder, correction)


def _write(
    done: Correction, episode: PolicyEpisode, k: int, folder: Path, correction: dict[str, Any] | None = None
) -> None:
    """What every correction leaves."""
    rows = len(done.recorder.rows) if done.recorder else 0
    entry = {
        "episode": k,
        "scene_seed": episode.seed,
        "policy_outcome": episode.outcome,
        "policy_steps": len(episode.actions),
        "outcome": done.outcome,
        "reason": done.reason,
        "takeover_step": done.takeover_step,
        "cause": done.cause,
        "rows": rows,
        "last_state": done.last_state,
        "correction": correction,
    }
    np.save(folder / "actions.npy", done.actions)
    np.save(folder / "intended.npy", done.intended)
    attempts.write_json(folder / "entry.json", entry)


def _simulation(plan: CorrectionPlan) -> tuple[Simulation, DatasetSpec]:
    """Made once in a process."""

    def make() -> tuple[Simulation, DatasetSpec]:
        sim = plan.make()
        return sim, plan.contract(sim)

    return attempts.made_once(["correction", plan.config(0)], make)


def correction_report(plan: CorrectionPlan, entries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Counts of outcomes of the policy and the expert, as JSON values. ``entries``: as in an entry.json, one for each episode."""

    def count(values: Sequence[str]) -> dict[str, int]:
        return dict(Counter(values).most_common())

    over = [e for e in entries if e["takeover_step"] is not None]
    return {
        "task": plan.task,
        **TWIN_ORIGIN.record(),
        "policy": plan.policy,
        "policy_digest": plan.policy_digest,
        "attempts": len(entries),
        "policy_outcomes": count([e["policy_outcome"] for e in entries]),
        "policy_successes": sum(e["policy_outcome"] == "success" for e in entries),
        "kept_out": sum(e["outcome"] == KEPT_OUT for e in entries),
        "taken_over": len(over),
        "causes": count([e["cause"] for e in over]),
        "outcomes": count([e["outcome"] + (f": {e['reason']}" * (e["outcome"] == "not taken over")) for e in entries]),
        "episodes": attempts.successes(entries),
        "rows": sum(e["rows"] for e in entries if attempts.is_success(e)),
        "entries": [
            {key: value for key, value in e.items() if key not in ("correction", "last_state")} for e in entries
        ],
    }
