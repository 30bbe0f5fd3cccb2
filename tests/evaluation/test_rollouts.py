"""One batch of episodes with stand-in actors whose ends are known beforehand."""

import dataclasses
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from taccorl.data.episode import EXECUTED
from taccorl.episodes.attempt import Actions, Targets
from taccorl.episodes.sources.correct import (
    CorrectionPlan,
    correct_episode,
    read_policy_episode,
)
from taccorl.errors import TaccorlError, UnreachableError
from taccorl.evaluation import rollouts
from taccorl.evaluation.evaluate import Scenes, score
from taccorl.evaluation.expert_actor import ExpertActor
from taccorl.evaluation.failed_episodes import choose_failures, execute_again
from taccorl.evaluation.policy_episodes import policy_episodes
from taccorl.evaluation.rollouts import Acted, Rollout
from taccorl.lineage.store import Store
from taccorl.sim.spaces import IMAGE_KEYS, STATE_KEY, TACTILE_KEY, Observation
from taccorl.sim.vector_env import TaccorlVectorEnv

STEPS = 6


class StandIn:
    """Holds still, but for what ``change(step, actions, envs)`` does to its actions."""

    name, needs_images, needs_part_poses, max_batch = "stand-in", False, False, None

    def __init__(
        self, change: Callable[[int, np.ndarray, TaccorlVectorEnv], None] | None = None
    ) -> None:
        self.change, self.step, self.streams = change, 0, list[int]()

    def looks_now(self) -> bool:
        return True

    def restart(self, stream: int = 0) -> None:
        self.streams.append(stream)

    def begin(self, envs: TaccorlVectorEnv, pictures: str) -> None:
        self.envs, self.step = envs, 0

    def act(self, observation: Observation) -> Acted:
        actions = observation[STATE_KEY].copy()
        if self.change:
            self.change(self.step, actions, self.envs)
        self.step += 1
        return Acted(actions)


def scenes(task: str = "assembly_1", **changes: object) -> Scenes:
    values: dict = {"tasks": (task,), "episodes": 3, "seed": 7, "episode_length": STEPS}
    return Scenes(**{**values, **changes})


def same(one: list[Rollout], other: list[Rollout]) -> bool:
    return [r.row for r in one] == [r.row for r in other] and all(
        np.array_equal(a.actions, b.actions) for a, b in zip(one, other, strict=True)
    )


def test_who_holds_still_runs_out_of_time() -> None:
    plugs: list[np.ndarray] = []

    def look(step: int, actions: np.ndarray, envs: TaccorlVectorEnv) -> None:
        if step == 0:
            plugs.extend(envs.sim.poses("plug")[:, :2, 3])

    rows = [r.row for r in score(scenes(), StandIn(look))]
    assert [[row.reset["plug_x_m"], row.reset["plug_y_m"]] for row in rows] == [
        plug.tolist() for plug in plugs
    ]
    assert all(
        0 <= row.measures["left_touch_counts"] < 10 for row in rows
    )  # noise; a grip has more than 50
    assert all(
        row.measures["plug_on_socket_n"] == 0.0 for row in rows
    )  # apart on the table
    assert [row.seed for row in rows] == [7, 8, 9]
    assert [row.outcome for row in rows] == ["timeout"] * 3
    assert all(
        row.steps == STEPS and row.time_s == pytest.approx(STEPS / 30) for row in rows
    )
    assert all(
        end is None
        for row in rows
        for own in row.subtask_end_s.values()
        for end in own.values()
    )
    assert rows[0].subtask_end_s.keys() == {"left", "right"} and all(
        len(v) == 2 for v in rows[0].subtask_end_s.values()
    )


def test_hidden_touch_reads_zero_from_the_mate_on_and_all_else_is_as_before() -> None:
    seen = []

    class Looking(ExpertActor):
        def act(self, observation: Observation) -> Acted:
            seen[-1].append(
                (observation[TACTILE_KEY].copy(), observation[STATE_KEY].copy())
            )
            return super().act(observation)

    for hidden in ((), ("touch_at_mate",)):
        seen.append([])
        (rollout,) = score(
            scenes(episodes=1, episode_length=None, hidden=hidden), Looking()
        )
        assert rollout.row.hidden == ", ".join(hidden) and rollout.row.success
    mate = int(np.argmax((rollout.subtasks >= 1).all(axis=1)))  # two subtasks an arm
    clear, at_mate = ([touch for touch, _ in own] for own in seen)
    assert all(
        np.array_equal(a, b) for a, b in zip(clear[:mate], at_mate[:mate], strict=True)
    )
    assert 0 < mate < len(clear) and np.any(clear[mate:]) and np.any(at_mate[:mate])
    assert not np.any(at_mate[mate:])
    assert all(
        np.array_equal(a[1], b[1]) for a, b in zip(*seen, strict=True)
    )  # the expert feels nothing


def test_hidden_cameras_are_black_and_what_is_hidden_is_checked() -> None:
    class Looking(StandIn):
        needs_images = True

        def act(self, observation: Observation) -> Acted:
            pictures.append(
                max(int(observation[key].max()) for key in IMAGE_KEYS.values())
            )
            return super().act(observation)

    for hidden, is_black in (
        ((), False),
        (("cameras_at_mate", "touch"), False),
        (("cameras",), True),
    ):
        pictures: list[int] = []
        score(scenes(episodes=1, episode_length=2, hidden=hidden), Looking())
        assert len(pictures) == 2 and (max(pictures) == 0) is is_black
    with pytest.raises(TaccorlError, match=r"--hide=tuch: .*touch"):
        scenes(hidden=("tuch",))
    with pytest.raises(TaccorlError, match="--hide=touch: give it once"):
        scenes(hidden=("touch", "touch"))


def test_memory_of_a_batch_is_allocated_once() -> None:
    # A small array that is kept in every step fragments the heap when large pictures are allocated and freed between them:
    # 32 environments took 13 GB in 900 steps.
    held = []

    def count(step: int, actions: np.ndarray, envs: TaccorlVectorEnv) -> None:
        if step in (5, 55):
            here = tracemalloc.take_snapshot().filter_traces(
                [tracemalloc.Filter(True, rollouts.__file__)]
            )
            held.append(sum(found.count for found in here.statistics("filename")))

    tracemalloc.start()
    try:
        score(scenes(episodes=4, episode_length=60), StandIn(count))
    finally:
        tracemalloc.stop()
    assert (
        len(held) == 2 and held[1] - held[0] < 50
    )  # an array for each step and environment would be 400


def test_a_bad_action_and_a_divergence_end_their_own_episode() -> None:
    def break_two(step: int, actions: np.ndarray, envs: TaccorlVectorEnv) -> None:
        if step >= 2:
            actions[0, 3] = np.nan  # and goes on with it after the end
        if step >= 4:
            actions[3, 1] = 90.0  # degrees
        if step == 3:
            envs.sim.arrays["qvel"][1, 20] = np.nan

    healthy, broken = (
        score(scenes(episodes=4), StandIn(change)) for change in (None, break_two)
    )
    rows = [r.row for r in broken]
    assert [row.outcome for row in rows] == [
        "bad_action",
        "diverged",
        "timeout",
        "bad_action",
    ]
    assert [row.steps for row in rows] == [2, 4, STEPS, 4]
    assert (
        rows[0].reason.startswith("action: left_joint4 is nan")
        and "left_joint2 is 90" in rows[3].reason
    )
    assert rows[1].reason == "" and same(broken[2:3], healthy[2:3])
    assert np.isfinite(list(rows[1].measures.values())).all()


def test_the_same_seeds_twice_give_the_same_rows_in_any_batch() -> None:
    def wander(step: int, actions: np.ndarray, envs: TaccorlVectorEnv) -> None:
        actions += 0.01 * np.sin(step + envs.sim.seeds[:, None])

    once = score(scenes(), StandIn(wander))
    assert same(once, score(scenes(), StandIn(wander)))
    assert same(
        once, score(scenes(batch_size=2), StandIn(wander))
    )  # batches of two and one
    assert not same(once, score(scenes(seed=8), StandIn(wander)))


def test_another_twin_moves_otherwise_in_the_same_scenes(tmp_path: Path) -> None:
    (tmp_path / "weak.yaml").write_text(
        "controller: {kp_nm_per_rad: [200.0, 200.0, 200.0, 100.0, 50.0, 50.0]}\n"
    )
    nominal, weak = (
        score(scenes(twin=twin), StandIn()) for twin in (None, tmp_path / "weak.yaml")
    )
    assert [r.row.seed for r in nominal] == [r.row.seed for r in weak]
    assert np.array_equal(
        nominal[0].actions[0], weak[0].actions[0]
    )  # the first observation is of the reset
    assert not np.array_equal(nominal[0].actions[-1], weak[0].actions[-1])


def test_a_target_beyond_the_limits_is_clipped_and_counted() -> None:
    def reach(step: int, actions: np.ndarray, envs: TaccorlVectorEnv) -> None:
        actions[:, 6] = 0.2 if step < 2 else 0.05

    assert [r.row.clipped_steps for r in score(scenes(), StandIn(reach))] == [2, 2, 2]


def test_actions_of_another_shape_are_refused() -> None:
    class Short(StandIn):
        def act(self, observation: Observation) -> Acted:
            return Acted(observation[STATE_KEY][:, :7])

    with pytest.raises(TaccorlError, match=r"shape \(3, 7\), expected \(3, 14\)"):
        score(scenes(), Short())


def test_random_numbers_begin_anew_for_each_task() -> None:
    actor = StandIn()
    rows = [
        r.row for r in score(scenes(tasks=("assembly_1", "puzzle"), episodes=1), actor)
    ]
    assert actor.streams == [0, 0] and [row.task for row in rows] == [
        "assembly_1",
        "puzzle",
    ]
    assert [row.max_partial for row in rows] == [1, 3]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"tasks": ("assembly1",)}, "did you mean 'assembly_1'"),
        ({"tasks": ()}, "missing --task=, one of assembly_1"),
        ({"tasks": ("puzzle", "puzzle")}, "each task once"),
        ({"difficulty": "trian"}, "did you mean 'train'"),
        ({"episodes": 0}, "--episodes=0: at least 1"),
        ({"seed": -1}, "--seed=-1"),
        ({"randomization": 2.0}, "--randomization=2"),
    ],
)
def test_scenes_that_cannot_be_are_refused(changes: dict, words: str) -> None:
    with pytest.raises(TaccorlError, match=words):
        scenes(**changes)


@pytest.mark.parametrize(
    ("way_out", "outcome", "reason"),
    [
        ("end", "unfinished", "the script ended without success"),
        ("pose", "unreachable", "left: 0.9 m away"),
    ],
)
def test_an_expert_that_cannot_go_on_ends_its_episode(
    way_out: str, outcome: str, reason: str
) -> None:
    class Short(ExpertActor):
        def begin(self, envs: TaccorlVectorEnv, pictures: str) -> None:
            self._actions = self._two_steps(envs)

        def _two_steps(self, envs: TaccorlVectorEnv) -> Actions:
            for _ in range(2):
                yield Targets(*2 * [envs.observe()[STATE_KEY][0]])
            if way_out == "pose":
                raise UnreachableError(reason)

    first, second = (r.row for r in score(scenes(episodes=2), Short()))
    assert (first.outcome, first.reason, first.steps) == (outcome, reason, 2)
    assert second.outcome == outcome and second.seed == 8


def test_failures_are_chosen_from_all_categories() -> None:
    (base,) = score(scenes(episodes=1), StandIn())
    ends = ["timeout", "timeout", "success", "dropped", "timeout", "dropped"]
    all_of_them = [
        dataclasses.replace(
            base, row=dataclasses.replace(base.row, seed=k, outcome=end)
        )
        for k, end in enumerate(ends)
    ]
    assert [r.row.seed for r in choose_failures(all_of_them, 3)] == [0, 3, 1]
    assert [r.row.seed for r in choose_failures(all_of_them, 9)] == [0, 3, 1, 5, 4]
    assert choose_failures(all_of_them, 0) == []
    unmoved = dataclasses.replace(base, row=dataclasses.replace(base.row, steps=0))
    assert choose_failures([unmoved], 3) == []


def test_a_failure_is_executed_again_bit_for_bit() -> None:
    seen: list[Observation] = []

    class Watching(StandIn):
        def act(self, observation: Observation) -> Acted:
            seen.append(observation)
            return Acted((observation[STATE_KEY] + 0.01).astype(np.float32))

    where = scenes(episodes=2)
    rollouts = score(where, Watching())
    again = execute_again(where, rollouts[1], images=False)
    for key in (STATE_KEY, "observation.tactile"):
        assert np.array_equal(
            again.episode.arrays[key], np.stack([o[key][1] for o in seen[:STEPS]])
        )
    assert again.episode.name == "assembly_1 seed 8, timeout" and again.pictures is None
    wrong = dataclasses.replace(
        rollouts[1], row=dataclasses.replace(rollouts[1].row, outcome="dropped")
    )
    with pytest.raises(TaccorlError, match=r"ends as timeout .*dropped"):
        execute_again(where, wrong, images=False)


@pytest.mark.slow
def test_the_expert_succeeds_where_it_is_known_to() -> None:
    from taccorl.episodes.recorder import row_spec
    from taccorl.episodes.sources.collect import CollectPlan, attempt
    from taccorl.episodes.sources.expert import ExpertSource

    plan = CollectPlan(task="assembly_1", images=False, source=ExpertSource())
    sim = plan.make()
    spec = row_spec(sim, pictures=False)
    collected = attempt(plan, sim, spec, 0)
    assert collected.outcome == "success"
    where = scenes(episodes=1, seed=plan.attempt_seed(0), episode_length=None)
    (found,) = score(where, ExpertActor())
    assert found.row.success and found.row.partial_credit == 1.0
    weight_n = 9.81 * sim.model.body("plug").mass[0]
    assert found.row.measures["plug_on_socket_n"] == pytest.approx(
        weight_n, rel=0.5
    )  # it rests in there, let go
    assert np.array_equal(
        found.actions, np.stack([row[EXECUTED] for row in collected.recorder.rows])
    )
    ends = [end for own in found.row.subtask_end_s.values() for end in own.values()]
    assert all(end is not None and 0 < end <= found.row.time_s for end in ends)


# ---- a policy's episodes for corrections ----


def plan(**changes: object) -> CorrectionPlan:
    values: dict = {
        "task": "assembly_2",
        "policy": "stand-in",
        "policy_digest": "0",
        "episodes": 3,
        "images": False,
    }
    return CorrectionPlan(**{**values, "episode_length": 6, **changes})


def wobble(step: int, actions: np.ndarray, envs: object) -> None:
    actions[:, :6] += 0.02 * np.sin(step + np.arange(len(actions)))[:, None]


def test_each_episode_is_made_once_and_executed_again_bit_for_bit(
    tmp_path: Path,
) -> None:
    store, loaded = Store(tmp_path), list[StandIn]()

    def load() -> StandIn:
        loaded.append(StandIn(wobble))
        return loaded[-1]

    found = policy_episodes(plan(), load, 2, store)
    assert len(found) == 2 and len(loaded) == 1 and loaded[0].streams == [0, 1]
    sim = plan().make()
    for k, seed in enumerate(plan().scene_seeds):
        episode = read_policy_episode(found[k // 2].path, k % 2)
        assert (episode.seed, episode.outcome, len(episode.actions)) == (
            seed,
            "timeout",
            6,
        )
        sim.reset([seed])
        for t, action in enumerate(episode.actions):
            assert np.array_equal(
                sim.proprioception()[0].astype(np.float32), episode.states[t]
            )
            assert np.array_equal(sim.judge.subtask[0], episode.subtasks[t])
            sim.step(action[None].astype(float))
        assert np.array_equal(
            sim.proprioception()[0].astype(np.float32), episode.states[-1]
        )
    sim.close()
    assert (
        policy_episodes(plan(takeover="all"), load, 2, store) == found
        and len(loaded) == 1
    )
    more = policy_episodes(
        plan(episodes=5), load, 2, store
    )  # the first batch is there, the second has one more scene
    assert more[0] == found[0] and loaded[-1].streams[-2:] == [1, 2]
    num = len(loaded)
    policy_episodes(plan(policy_digest="1"), load, 2, store)
    assert len(loaded) == num + 1


def standing() -> StandIn:
    return StandIn(wobble)


@pytest.mark.slow
def test_batches_in_several_processes_are_the_same(tmp_path: Path) -> None:
    one = policy_episodes(plan(), standing, 1, Store(tmp_path / "one"))
    other = policy_episodes(plan(), standing, 1, Store(tmp_path / "other"), workers=2)
    assert [batch.digest for batch in one] == [batch.digest for batch in other]


@pytest.mark.slow
def test_the_expert_completes_what_a_policy_of_a_batch_began(tmp_path: Path) -> None:
    its = plan(episodes=2)
    found = policy_episodes(its, lambda: StandIn(wobble), 2, Store(tmp_path))
    sim = its.make()
    done = [
        correct_episode(
            its, sim, its.contract(sim), read_policy_episode(found[0].path, k)
        )
        for k in range(2)
    ]
    assert [one.outcome for one in done] == ["success", "success"]
    assert [one.facts["cause"] for one in done] == ["drawn before the grasp"] * 2
    sim.close()
