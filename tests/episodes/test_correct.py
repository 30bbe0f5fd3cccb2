"""Corrections: where the expert takes over, from which states, and what becomes of each of the policy's episodes."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from taccorl.data.dataset import Dataset
from taccorl.data.episode import EXECUTED
from taccorl.episodes.produce import check_out, produce
from taccorl.episodes.sources.correct import (
    CorrectionPlan,
    PolicyEpisode,
    correct_episode,
    first_stall,
    is_stall,
    read_policy_episode,
    takeover_step,
    write_policy_episodes,
)
from taccorl.errors import InTheWayError, LostError, TaccorlError
from taccorl.lineage.engines import LocalEngine
from taccorl.lineage.store import Store
from taccorl.robots import ROBOT
from taccorl.sim.part_poses import PARTS_KEY
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.tasks.experts import expert_of
from taccorl.tasks.experts.hands import EXACT, ScriptedExpertConfig
from taccorl.tasks.experts.scripted import ScriptedExpert

TASK = "assembly_2"
PUSH_RAD = 0.02


def plan(**changes: object) -> CorrectionPlan:
    values: dict = {
        "task": TASK,
        "policy": "a policy",
        "policy_digest": "0" * 64,
        "episodes": 2,
        "images": False,
    }
    return CorrectionPlan(**{**values, **changes})


@pytest.fixture(scope="module")
def sim() -> Simulation:
    return plan().make()


Act = Callable[[int], np.ndarray | None]


def acted(
    sim: Simulation, seed: int, act: Act, outcome: str = "timeout"
) -> PolicyEpisode:
    """The episode of a policy that does ``act(t)`` until that is None."""
    sim.reset([seed])
    actions, states, subtasks = (
        [],
        [sim.proprioception()[0]],
        [sim.judge.subtask[0].copy()],
    )
    while (action := act(len(actions))) is not None:
        actions.append(action.astype(np.float32))
        sim.step(actions[-1][None].astype(np.float64))
        states.append(sim.proprioception()[0])
        subtasks.append(sim.judge.subtask[0].copy())
    actions = np.array(actions).reshape(-1, 14)
    return PolicyEpisode(
        seed,
        outcome,
        actions,
        np.array(states, np.float32),
        np.array(subtasks, np.int16),
    )


def held_still(sim: Simulation, seed: int, steps: int) -> PolicyEpisode:
    return acted(sim, seed, lambda t: sim.targets[0].copy() if t < steps else None)


def pushed_expert(sim: Simulation, seed: int, after: int) -> PolicyEpisode:
    """The expert; ``after`` steps after both parts are held its joints are pushed off by 0.02 rad over 10 steps, and it ends."""
    expert = expert_of(sim.task)(sim, np.random.default_rng([seed, 1]))
    push = np.random.default_rng(seed).normal(size=14) * PUSH_RAD
    push[[6, 13]] = 0.0
    held_at: list[int] = []

    def act(t: int) -> np.ndarray | None:
        if t == 0:
            expert.start()
        if not held_at and (sim.judge.subtask[0] >= 1).all():
            held_at.append(t)
        since = t - held_at[0] - after if held_at else 0
        if since > 10:
            return None
        return np.clip(
            expert.act() + np.clip(since / 10, 0, 1) * push,
            ROBOT.action_low,
            ROBOT.action_high,
        )

    return acted(sim, seed, act)


def test_policy_episodes_are_read_as_they_were_written(
    sim: Simulation, tmp_path: Path
) -> None:
    written = [held_still(sim, seed, steps) for seed, steps in ((5, 3), (6, 0), (7, 4))]
    write_policy_episodes(written, tmp_path)
    for k, episode in enumerate(written):
        read = read_policy_episode(tmp_path, k)
        assert (read.seed, read.outcome) == (episode.seed, episode.outcome)
        assert np.array_equal(read.actions, episode.actions) and read.actions.shape == (
            (3, 0, 4)[k],
            14,
        )
        assert (
            np.array_equal(read.states, episode.states)
            and len(read.states) == len(read.actions) + 1
        )
        assert np.array_equal(read.subtasks, episode.subtasks) and len(
            read.subtasks
        ) == len(read.states)


def test_a_stall_is_a_second_without_motion_and_without_progress() -> None:
    still, same = np.zeros((31, 14)), np.zeros((31, 2), int)
    assert is_stall(still, same) and not is_stall(
        still[1:], same[1:]
    )  # 30 rows are 29 steps
    for column, amount, stalls in (
        (0, 0.019, True),
        (0, 0.021, False),
        (13, 0.0009, True),
        (13, 0.0011, False),
    ):
        moved = still.copy()
        moved[15, column] = amount
        assert is_stall(moved, same) is stalls
    assert not is_stall(still, np.repeat([[0, 1], [1, 1]], (20, 11), axis=0))


def test_scenes_do_not_depend_on_their_number_and_are_not_those_of_an_evaluation() -> (
    None
):
    assert plan(episodes=4).scene_seeds[:2] == plan().scene_seeds
    assert min(plan(episodes=50).scene_seeds) > 1000 + 10**6
    assert not set(plan(episodes=50, seed=1).scene_seeds) & set(
        plan(episodes=50).scene_seeds
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"task": "assembly2"}, "did you mean"),
        ({"takeover": "failure"}, "--takeover=failure: did you mean 'failures'?"),
        ({"per_episode": 0}, "--per_episode=0"),
    ],
)
def test_wrong_words_are_named(changes: dict, message: str) -> None:
    with pytest.raises(TaccorlError, match=message.replace("?", r"\?")):
        plan(**changes)


def test_an_expert_that_begins_at_the_beginning_only_is_refused_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        expert_of(tasks.get("puzzle")), "remaining", ScriptedExpert.remaining
    )
    with pytest.raises(TaccorlError, match="--task=puzzle"):
        plan(task="puzzle")


# where the expert takes over ------------------------------------------------------------------------------------------


class Stub:
    """In the expert's place: holds still, and has finished."""

    def __init__(
        self, sim: Simulation, rng: np.random.Generator, hands: ScriptedExpertConfig
    ) -> None:
        self.sim, self.events, self.done = sim, [], True

    can_resume = classmethod(lambda cls: True)

    def resume(self) -> None:
        pass

    def act(self) -> np.ndarray:
        return self.sim.targets[0].astype(np.float32)

    def intended(self, action: np.ndarray) -> np.ndarray:
        return action


@pytest.fixture
def stub(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("taccorl.episodes.sources.expert.AFTER_S", 0.1)
    monkeypatch.setattr("taccorl.episodes.sources.correct.expert_of", lambda task: Stub)


def moving(
    num: int,
    *,
    held_from: int | None = None,
    still: range = range(0),
    outcome: str = "timeout",
) -> PolicyEpisode:
    """An episode of ``num`` steps whose joints move by 0.1 rad a step but in ``still``, with both parts held from a step on."""
    states, subtasks = (
        np.zeros((num + 1, 14), np.float32),
        np.zeros((num + 1, 2), np.int16),
    )
    states[:, 0] = 0.1 * np.cumsum([t not in still for t in range(num + 1)])
    subtasks[num + 1 if held_from is None else held_from :] = 1
    return PolicyEpisode(7, outcome, np.zeros((num, 14), np.float32), states, subtasks)


def share(number: int, seed: int = 7) -> float:
    return np.random.default_rng([seed, 1, number]).uniform()


def test_takeovers_are_drawn_after_the_grasp_or_over_all_steps() -> None:
    """Shares s of the numbers 0, 1, 2 … of 400 steps with the parts held from 100 on: 100 + 300 s, or 400 s from the reset on."""
    for number in range(6):
        s, episode = share(number), moving(400, held_from=100)
        assert takeover_step(episode, number, before_grasp=False) == (
            100 + int(300 * s),
            "drawn",
        )
        step = int(400 * s)
        cause = "drawn" if step >= 100 else "drawn before the grasp"
        assert takeover_step(episode, number, before_grasp=True) == (step, cause)
        assert takeover_step(moving(400), number, before_grasp=False) == (
            step,
            "drawn before the grasp",
        )
    assert (
        len(
            {
                takeover_step(moving(400), number, before_grasp=False)
                for number in range(6)
            }
        )
        == 6
    )
    assert takeover_step(moving(0), 0, before_grasp=False) == (
        0,
        "drawn before the grasp",
    )


def test_one_takeover_is_at_the_stall_and_the_others_before_it() -> None:
    """Steps 200 … 240 still: after 30 steps without motion, at 229, the policy has stalled."""
    episode = moving(400, held_from=100, still=range(200, 240))
    assert first_stall(episode) == 229
    drawn = 100 + int(300 * share(0))
    assert takeover_step(episode, 0, before_grasp=False) == (
        (229, "stall") if drawn >= 229 else (drawn, "drawn")
    )
    late = next(seed for seed in range(99) if 100 + int(300 * share(0, seed)) >= 229)
    at = PolicyEpisode(
        late, "timeout", episode.actions, episode.states, episode.subtasks
    )
    assert takeover_step(at, 0, before_grasp=False) == (229, "stall")
    for number in range(1, 30):
        assert takeover_step(at, number, before_grasp=False) == (
            100 + int(129 * share(number, late)),
            "drawn",
        )
    # The rest of half a second before a success is no stall; the same rest in a failed episode is one.
    assert first_stall(moving(240, still=range(200, 240), outcome="success")) is None
    assert first_stall(moving(240, still=range(200, 240))) == 229
    # A stall before the grasp: others are drawn over all steps before it.
    early = moving(400, held_from=300, still=range(200, 240))
    assert takeover_step(early, 1, before_grasp=False) == (
        int(229 * share(1)),
        "drawn before the grasp",
    )


def test_a_policy_with_more_time_than_the_task_s_own_is_taken_over_beyond_it(
    sim, stub, monkeypatch
):
    """The limit is 4 steps, also of the expert, which acts for 3 here; the seed draws a step beyond."""
    seed = next(seed for seed in range(99) if share(0, seed) > 0.8)
    episode = held_still(sim, seed, 10)
    monkeypatch.setattr(sim.judge, "limit_steps", 4)
    done = correct_episode(plan(episode_length=10), sim, plan().contract(sim), episode)
    assert (
        done.facts["cause"] == "drawn before the grasp"
        and done.facts["takeover_step"] == int(10 * share(0, seed)) >= 8
    )
    assert done.rows == 3 and sim.judge.limit_steps == 4


def test_a_policy_that_holds_still_has_stalled_after_a_second(
    sim: Simulation, stub: None
) -> None:
    seed = next(seed for seed in range(99) if share(0, seed) > 0.75)
    done = correct_episode(plan(), sim, plan().contract(sim), held_still(sim, seed, 40))
    assert done.facts == {"takeover_step": 30, "cause": "stall"}


def test_the_first_row_is_the_policys_state_which_must_be_the_same_in_every_bit(
    sim: Simulation, stub: None
) -> None:
    episode = held_still(sim, 3, 10)
    done = correct_episode(plan(), sim, plan().contract(sim), episode)
    assert done.recorder is not None
    first = done.recorder.rows[0]["observation.state"]
    assert np.array_equal(first, episode.states[done.facts["takeover_step"]])
    episode.states[:, 4] = np.nextafter(episode.states[:, 4], np.float32(9))
    done = correct_episode(plan(), sim, plan().contract(sim), episode)
    assert done.outcome == "not reproduced" and not done.facts and done.recorder is None


def test_what_the_policy_completes_by_itself_is_kept_out_unless_all_is_asked_for(
    tmp_path: Path,
) -> None:
    """Batches of two episodes and one, of which the second succeeded: takeovers 0.0, 0.1, 2.0, 2.1, and with ``all`` 1.0, 1.1."""
    store, batches = Store(tmp_path / "store"), []
    for k, outcomes in enumerate((("timeout", "success"), ("dropped",))):
        (tmp_path / str(k)).mkdir()
        write_policy_episodes(
            [moving(3, outcome=outcome) for outcome in outcomes], tmp_path / str(k)
        )
        batches.append(store.source(tmp_path / str(k)))
    found, outcomes = plan(per_episode=2, acted=tuple(batches)).takeovers()
    assert [str(item) for item in found] == ["0.0", "0.1", "2.0", "2.1"] and found[
        2
    ].index == 0
    assert outcomes == ["timeout", "success", "dropped"]
    found, _ = plan(takeover="all", per_episode=2, acted=tuple(batches)).takeovers()
    assert [str(item) for item in found] == ["0.0", "0.1", "1.0", "1.1", "2.0", "2.1"]


# from which states ----------------------------------------------------------------------------------------------------


def put(sim: Simulation, part: str, *, up_m: float = 0.0, rolled: bool = False) -> None:
    """Move a free part up, or roll it about its own z axis onto another side."""
    at = sim.model.joint(part).qposadr[0]
    sim.arrays["qpos"][0, at + 2] += up_m
    if rolled:
        w, x, y, z = sim.arrays["qpos"][0, at + 3 : at + 7]
        half = np.sqrt(0.5)
        sim.arrays["qpos"][0, at + 3 : at + 7] = half * np.array(
            [w - z, x + y, y - x, z + w]
        )
    sim.batch.forward(np.array([0]))


@pytest.mark.parametrize(
    ("how", "message"),
    [({"rolled": True}, "another side"), ({"up_m": 0.2}, "in no hand")],
)
@pytest.mark.parametrize("part", ["plug", "cradle"])
def test_a_part_that_cannot_be_gripped_is_a_lost_state(
    sim: Simulation, part: str, how: dict, message: str
) -> None:
    sim.reset([0])
    put(sim, part, **how)
    with pytest.raises(LostError, match=f"{part} .*{message}"):
        expert_of(sim.task)(sim, np.random.default_rng(0)).resume()


def test_a_lost_state_is_counted(
    sim: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost(expert: object, arm: str) -> None:
        raise LostError("plug is lost")

    monkeypatch.setattr(expert_of(tasks.get(TASK)), "remaining", lost)
    done = correct_episode(plan(), sim, plan().contract(sim), held_still(sim, 3, 4))
    assert (done.outcome, done.reason) == ("not taken over", "plug is lost")


@pytest.mark.parametrize("task", ["assembly_1", "assembly_2", "test_tube", "puzzle"])
def test_arms_do_not_jump_at_the_takeover(task: str) -> None:
    sim = Simulation(tasks.get(task)())
    sim.reset([0])
    goal = sim.targets[0] + np.r_[np.full(6, 0.05), 0, np.full(6, -0.05), 0]
    for k in range(4):
        sim.step((sim.targets[0] + (goal - sim.targets[0]) * (k + 1) / 4)[None])
    before = sim.targets[0].copy()
    expert = expert_of(sim.task)(sim, np.random.default_rng(0), EXACT)
    expert.resume()
    assert np.abs(expert.act() - before)[[*range(6), *range(7, 13)]].max() < 0.02
    sim.close()


@pytest.mark.parametrize("task", ["assembly_1", "test_tube", "puzzle"])
def test_a_hand_on_the_way_to_a_part_goes_on_and_one_at_the_part_closes(
    task: str,
) -> None:
    """The expert takes over a hand 30 mm above a part, and one whose pads have begun to close on it: neither rises or opens."""
    sim, right = plan(task=task).make(), ROBOT.gripper_index("right")
    heights: list[float] = []

    def act(t: int) -> np.ndarray | None:
        if t == 0:
            expert.start()
        heights.append(float(sim.tcp("right")[0, 2, 3]))
        return expert.act() if sim.targets[0, right] > 0.06 else None

    expert = expert_of(sim.task)(sim, np.random.default_rng(3), EXACT)
    actions = acted(sim, 3, act).actions
    for step in (
        int(np.flatnonzero(np.array(heights) > heights[-1] + 0.03)[-1]),
        len(actions),
    ):
        acted(sim, 3, lambda t, step=step: actions[t] if t < step else None)
        expert, rows, begun_m = (
            expert_of(sim.task)(sim, np.random.default_rng(4), EXACT),
            [],
            sim.tcp("right")[0, 2, 3],
        )
        expert.resume()
        while sim.targets[0, right] > 0.04 and len(rows) < 90:
            rows.append((sim.targets[0, right], sim.tcp("right")[0, 2, 3] - begun_m))
            sim.step(expert.act()[None].astype(np.float64))
        openings_m, risen_m = np.array(rows).T
        assert (
            risen_m.max() < 0.003
            and np.diff(openings_m).max() < 1e-6
            and len(rows) < 90
        )
    sim.close()


@pytest.mark.slow
@pytest.mark.parametrize("task", ["assembly_1", "assembly_2", "test_tube", "puzzle"])
@pytest.mark.parametrize("after", [5, 45])
def test_the_expert_completes_what_was_pushed_by_20_mrad(task: str, after: int) -> None:
    sim = Simulation(tasks.get(task)())
    its = plan(task=task)
    done = correct_episode(its, sim, its.contract(sim), pushed_expert(sim, 11, after))
    assert done.facts["cause"] == "drawn" and done.outcome == "success", (
        done.outcome,
        done.reason,
    )
    sim.close()


# the dataset ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def corrected(
    sim: Simulation, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, CorrectionPlan, dict]:
    """Two episodes of a policy that is the expert, pushed in mid-air, each taken over twice; and one in which it succeeds."""
    folder, its = (
        tmp_path_factory.mktemp("corrected"),
        plan(episodes=3, per_episode=2, part_poses=True),
    )
    episodes = [pushed_expert(sim, seed, 30) for seed in its.scene_seeds[:2]]
    episodes.append(success(its.scene_seeds[2]))
    (folder / "acted").mkdir()
    write_policy_episodes(episodes, folder / "acted")
    store = Store(folder / "store")
    its = dataclasses.replace(its, acted=(store.source(folder / "acted"),))
    return folder, its, produce(its, folder / "out", store, quiet).report


def quiet(_: str) -> None:
    pass


def success(seed: int) -> PolicyEpisode:
    return PolicyEpisode(
        seed,
        "success",
        np.zeros((1, 14), np.float32),
        np.zeros((2, 14)),
        np.zeros((2, 2), np.int16),
    )


@pytest.mark.slow
def test_the_dataset_holds_the_experts_rows_and_says_from_where(
    corrected: tuple, sim: Simulation
) -> None:
    folder, its, report = corrected
    assert (
        report["policy_outcomes"] == {"timeout": 2, "success": 1}
        and report["kept_out"] == 1
    )
    assert report["taken_over"] == report["attempts"] == 4 and report["outcomes"] == {
        "success": 4
    }
    dataset = Dataset(folder / "out")
    assert dataset.num_episodes == report["episodes"] == 4
    for i, entry in enumerate(report["entries"]):
        assert (entry["episode"], entry["number"]) == divmod(i, 2)
        episode = dataset.episode(i)
        simulation = episode.provenance["simulation"]
        assert isinstance(simulation, dict)
        made = simulation["correction"]
        assert made["takeover_step"] == entry["takeover_step"] < entry["policy_steps"]
        assert (
            made["scene_seed"] == its.scene_seeds[i // 2]
            and made["policy_digest"] == its.policy_digest
        )
        assert (
            episode.origin.domain == "twin"
            and "not a robot" in episode.origin.text
            and episode.success
        )
        acted = read_policy_episode(folder / "acted", i // 2)
        assert np.array_equal(
            episode.arrays["observation.state"][0], acted.states[made["takeover_step"]]
        )
        assert len(episode.arrays["action"]) == entry["rows"]
        assert episode.arrays["sim.success"][-1, 0] == 1
        assert episode.arrays[PARTS_KEY].shape == (
            entry["rows"],
            18,
        )  # plug and cradle: position and two columns each
        off_rad = np.abs(episode.arrays["action"] - episode.arrays[EXECUTED])
        assert (
            1e-3 < off_rad.max() < 0.2
        )  # the expert's aim is 1 mm and 15 mrad off, its hand trembles
        assert not off_rad[:, [6, 13]].any()  # grippers neither aim nor tremble
    steps = [entry["takeover_step"] for entry in report["entries"]]
    assert steps[0] != steps[1] and steps[2] != steps[3]


@pytest.mark.slow
def test_the_policys_actions_and_the_executed_ones_bring_the_episode_back(
    corrected: tuple, sim: Simulation
) -> None:
    folder, its, report = corrected
    dataset = Dataset(folder / "out")
    for i, entry in enumerate(report["entries"]):
        rows, step = dataset.episode(i).arrays, entry["takeover_step"]
        sim.reset([its.scene_seeds[i // 2]])
        states = []
        for action in [
            *read_policy_episode(folder / "acted", i // 2).actions[:step],
            *rows[EXECUTED],
        ]:
            states.append(sim.state_rows()[0])
            sim.step(action[None].astype(np.float64))
        assert np.array_equal(rows["sim.state"], np.array(states)[step:])


@pytest.mark.slow
def test_again_nothing_is_made_and_any_number_of_workers_gives_the_same(
    corrected: tuple, tmp_path: Path
) -> None:
    folder, its, report = corrected
    store = Store(folder / "store")
    made = {path.name: path.stat().st_mtime_ns for path in store.artefacts()}
    assert produce(its, folder / "out", store, quiet).report == report
    assert {path.name: path.stat().st_mtime_ns for path in store.artefacts()} == made
    other = Store(tmp_path / "store")
    assert (
        produce(its, tmp_path / "out", other, quiet, LocalEngine(workers=2)).report
        == report
    )
    one, two = (
        next((place / "out/data").rglob("*.parquet")) for place in (folder, tmp_path)
    )
    assert one.read_bytes() == two.read_bytes()


def test_nothing_is_written_where_nothing_was_corrected(tmp_path: Path) -> None:
    its = plan(episodes=1)
    (tmp_path / "acted").mkdir()
    write_policy_episodes([success(its.scene_seeds[0])], tmp_path / "acted")
    store = Store(tmp_path / "store")
    with pytest.raises(
        TaccorlError,
        match=r"no episode was corrected.*episodes: 1 success; takeovers: none.*--takeover=all",
    ):
        produce(
            dataclasses.replace(its, acted=(store.source(tmp_path / "acted"),)),
            tmp_path / "out",
            store,
            quiet,
        )
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_what_is_in_the_way_is_named_before_the_policy_acts(
    corrected: tuple, tmp_path: Path
) -> None:
    (tmp_path / "mine").touch()
    with pytest.raises(InTheWayError, match="is occupied"):
        check_out(plan(), tmp_path, Store(tmp_path / "store"))
    folder, its, _ = corrected
    before = dataclasses.replace(its, acted=())
    check_out(before, folder / "out", Store(tmp_path / "store"))
    with pytest.raises(InTheWayError, match="out is occupied"):
        check_out(
            dataclasses.replace(before, episodes=4),
            folder / "out",
            Store(tmp_path / "store"),
        )
