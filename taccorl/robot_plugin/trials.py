"""Trials of a policy on a robot, for ``taccorl evaluate --robot.type=…``: the paper's protocol, 20 trials of a task.

LeRobot's rollout runs the policy, with real-time chunking if it can. A trial is one connection of the robot. On a robot, a person
puts the scene in order and judges by a key; on a surrogate, each trial has the scene of its own seed, which the task's predicate
judges. A trial whose connection is lost is void: reported and repeated, never counted.
"""

import dataclasses
import json
import select
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import draccus
import lerobot.scripts.lerobot_rollout  # noqa: F401  registers LeRobot's robots and cameras
import numpy as np
from lerobot.robots import RobotConfig
from lerobot.rollout import RolloutConfig, build_rollout_context, create_strategy
from lerobot.rollout.inference import RTCInferenceConfig
from lerobot.utils.random_utils import set_seed

from taccorl.errors import TaccorlError, nearest
from taccorl.evaluation.episodes import (
    ROWS_FILE,
    SUCCESS,
    SUMMARY_FILE,
    EpisodeRow,
    read_rows,
    write_rows,
)
from taccorl.evaluation.evaluate import is_stored
from taccorl.report.evaluated import Evaluation
from taccorl.robot_plugin import lerobot_hooks
from taccorl.robot_plugin.bodies import SurrogateArms
from taccorl.robot_plugin.config_robots import TouchOptions
from taccorl.robot_plugin.robots import TouchRobot
from taccorl.robot_plugin.safety import Stopped
from taccorl.sim.task import Task, tasks
from taccorl.sim.twin import CONTROL_HZ

MOST_VOID = 3
"""The evaluation stops after so many void trials in a row."""
_KEYS = "y: success, n or n WHY: failure, v: void; then Enter"
_POLL_S = 0.05


class Void(TaccorlError):
    """The trial cannot be counted: the connection was lost, or a person says so."""


class Quit(TaccorlError):
    """The evaluation ends; the trials so far are kept."""


class Verdict(NamedTuple):
    """How a trial ended: outcome, goals in place, simulated time (None: that of the loop) and reason."""

    outcome: str
    partial: int = 0
    time_s: float | None = None
    reason: str = ""


@dataclass
class _Rollout(RolloutConfig):
    def __post_init__(self) -> None:
        """LeRobot's own reads the command line of lerobot-rollout."""


class Trials:
    """Runs a policy on a robot, one trial after another. ``options``: the robot's options as given by ``--robot.…``, by name;
    ``policy``: configuration of a checkpoint, with its path. Raises TaccorlError: an option is wrong, the robot does not answer,
    the policy does not fit it, or the surrogate runs another task."""

    def __init__(self, options: dict[str, Any], policy: Any, task: type[Task]) -> None:
        try:
            config = draccus.decode(RobotConfig, options)
        except (draccus.utils.DecodingError, ValueError, ImportError) as error:
            known, kind = RobotConfig.get_known_choices(), options["type"]
            text = (
                f".type={kind}: {nearest(kind, known)}"
                if kind not in known
                else f": {' '.join(str(error).split())}"
            )
            raise TaccorlError(f"--robot{text}") from error
        if not isinstance(config, TouchOptions):
            text = "has no limits and stops: give --robot.type=touch_robot --robot.robot='{type: …}'"
            raise TaccorlError(f"--robot.type={options['type']}: {text}")
        if config.dry_run or config.record:
            raise TaccorlError(
                "--robot.dry_run, --robot.record: a trial moves, and has its own recording: remove them"
            )
        made = _Rollout(
            robot=config,
            policy=policy,
            task=task.instruction,
            device=policy.device,
            fps=CONTROL_HZ,
        )
        if hasattr(policy, "rtc_config"):
            made.inference = RTCInferenceConfig()
        lerobot_hooks.install()
        self.task, self._ended, self._found = task, threading.Event(), list[Any]()
        self._ctx = build_rollout_context(made, self._ended)
        self._strategy: Any = create_strategy(made.strategy)
        self.robot: TouchRobot = self._ctx.hardware.robot_wrapper.inner  # pyright: ignore[reportAttributeAccessIssue]
        body = self.robot.body
        self.link = body.link if isinstance(body, SurrogateArms) else None
        if isinstance(body, SurrogateArms) and body.task != task.name:
            self.robot.disconnect()
            raise TaccorlError(
                f"--task={task.name}: the surrogate on that port runs {body.task}"
            )

    def trial(
        self, name: str, seed: int, limit_s: float, record: Path | None
    ) -> EpisodeRow:
        """Run one trial of at most ``limit_s``, recorded in the file ``record``. ``seed``: of the scene, on a surrogate. Raises
        Void: the trial cannot be counted; Quit: the person who judges ends the evaluation."""
        robot, ctx = self.robot, self._ctx
        if robot.is_connected:
            robot.disconnect()
        robot.config.record, self._limit_s, homes = record, limit_s, False
        ctx.runtime.cfg.duration = (
            limit_s if self.link is None else 0
        )  # a surrogate's own time counts
        if (
            self.link is None
            and _line(
                f"put the scene in order, then Enter (q ends). Meanwhile: {_KEYS}"
            )
            == "q"
        ):
            raise Quit("ended by q")
        self._found = []
        self._ended.clear()
        judge = threading.Thread(target=self._judge, daemon=True)
        try:
            robot.connect()
            robot.begin_episode(seed)
            self._strategy.setup(ctx)
            judge.start()
            self._strategy.run(ctx)
            if self._strategy._engine.failed:
                raise TaccorlError(
                    "the policy predicts no actions; LeRobot's messages above say why"
                )
            verdict, homes = (
                self._found[0] if self._found else Verdict("timeout"),
                self.link is None,
            )
        except Stopped as error:
            if robot.guard.is_lost:
                raise Void(str(error)) from error
            verdict = Verdict("stopped", reason=robot.guard.stopped)
        except (TaccorlError, OSError) as error:
            raise Void(str(error)) from error
        finally:
            self._ended.set()
            self._strategy._teardown_hardware(
                ctx.hardware, return_to_initial_position=homes
            )
        if isinstance(verdict, TaccorlError):
            raise (
                verdict if isinstance(verdict, Quit) else Void(str(verdict))
            ) from verdict
        while self.link is None and (
            answer := _line(
                f"{verdict.outcome} {verdict.reason}: Enter keeps it; {_KEYS}"
            )
        ):
            verdict = self._of_key(answer) or verdict
        if verdict.outcome == "void":
            raise Void("by key")
        periods, counts = (
            np.array(robot.timing.get("period", (np.nan,))),
            robot.guard.counts,
        )
        measures = {
            "period_mean_ms": 1e3 * periods.mean(),
            "period_p99_ms": 1e3 * float(np.percentile(periods, 99)),
        }
        measures["holds"] = counts["hold"]
        return EpisodeRow(
            policy=name,
            task=self.task.name,
            seed=seed,
            outcome=verdict.outcome,
            partial=verdict.partial,
            max_partial=self.task.max_partial,
            steps=len(robot.timing.get("period", ())) + 1,
            time_s=float(np.nansum(periods))
            if verdict.time_s is None
            else verdict.time_s,
            subtask_end_s={},
            clipped_steps=counts["limit"],
            measures={
                k: round(float(v), 2) for k, v in measures.items() if np.isfinite(v)
            },
            reason=verdict.reason,
        )

    def _judge(self) -> None:
        """Wait in a thread for a verdict, and end the trial then, or when nobody can give one any more."""
        while not self._ended.wait(_POLL_S):
            try:
                verdict = self._verdict()
            except TaccorlError as error:
                verdict = error
            if verdict is not None:
                self._found.append(verdict)
                self._ended.set()

    def _verdict(self) -> Verdict | None:
        """The surrogate's verdict, or that of a line that was typed; None: none yet."""
        if self.link is None:
            return (
                self._of_key(_line())
                if select.select([sys.stdin], [], [], 0)[0]
                else None
            )
        said = self.link.request("outcome")["outcome"]
        outcome = SUCCESS if said["success"] else said["failure"]
        outcome = outcome or "timeout" * (said["seconds"] >= self._limit_s)
        return Verdict(outcome, said["partial"], said["seconds"]) if outcome else None

    def _of_key(self, answer: str) -> Verdict | None:
        """Verdict that the line ``answer``, typed by a person, stands for; None if it is no valid answer, which is then said."""
        key, _, why = answer.partition(" ")
        if key == "y":
            return Verdict(SUCCESS, self.task.max_partial)
        if key in ("n", "v"):
            return Verdict("void" if key == "v" else why.strip() or "failed")
        print(f"{answer!r} is no answer. {_KEYS}", flush=True)
        return None


def _line(question: str = "") -> str:
    """A line that a person types. Raises Quit: the standard input is closed."""
    if question:
        print(question, flush=True)
    if not (found := sys.stdin.readline()):
        raise Quit("the standard input is closed, but a person must judge")
    return found.strip()


def evaluate_on_robot(
    found: Evaluation,
    policy: Any,
    options: dict[str, Any],
    out: Path,
    recordings: Path | None,
) -> Evaluation:
    """``found`` with the trials of its scenes' seeds, of which those that ``out`` has are not repeated; after each trial its rows
    and summary are written there. ``recordings``: folder of the trials' recordings. Raises TaccorlError: as ``Trials``; ``out``
    holds something else; ``MOST_VOID`` trials in a row are void; a person ends it."""
    scenes, label = (
        found.scenes,
        "a surrogate" if options["type"] == "taccorl_surrogate" else options["type"],
    )
    found.policies[0].name += f" on {label}"
    origin = f"Run on {label}{', not a robot' if label == 'a surrogate' else ', judged by a person'}"
    found = dataclasses.replace(
        found, robot={"options": options, "origin": origin, "void": []}
    )
    found = dataclasses.replace(found, **_kept(found, out))
    task, rows, void = tasks.get(scenes.tasks[0]), list(found.rows), found.robot["void"]
    limit_s = (
        task.time_limit_s
        if scenes.episode_length is None
        else scenes.episode_length / CONTROL_HZ
    )
    left, in_a_row = (
        [seed for seed in scenes.seeds if seed not in {row.seed for row in rows}],
        0,
    )
    set_seed(scenes.seed)
    trials = Trials(options, policy, task)
    try:
        while left:
            path = (
                recordings / f"{task.name}_seed_{left[0]}.mcap"
                if recordings and trials.robot.is_piper
                else None
            )
            if path is not None:
                path.unlink(missing_ok=True)  # of a void trial
            print(
                f"trial {len(rows) + 1} of {scenes.episodes}, seed {left[0]}",
                flush=True,
            )
            try:
                rows.append(
                    trials.trial(found.policies[0].name, left[0], limit_s, path)
                )
                print(
                    f"  {rows[-1].outcome} after {rows[-1].time_s:.1f} s {rows[-1].reason}".rstrip(),
                    flush=True,
                )
                left, in_a_row = left[1:], 0
            except Void as error:
                void.append({"seed": left[0], "reason": str(error)})
                print(f"  void, not counted: {error}", flush=True)
                in_a_row += 1
            found = dataclasses.replace(found, rows=rows)
            write_rows(rows, out / ROWS_FILE)
            (out / SUMMARY_FILE).write_text(
                json.dumps(found.to_json(), indent=1, ensure_ascii=False),
                encoding="utf-8",
            )
            if in_a_row == MOST_VOID:
                raise Quit(
                    f"{in_a_row} void trials in a row, the last: {void[-1]['reason']}"
                )
    except (Quit, KeyboardInterrupt) as error:
        text = f"{str(error) or 'Ctrl-C'}; {len(rows)} trials are kept: the same command goes on"
        raise TaccorlError(text) from error
    finally:
        trials.robot.disconnect()
    return found


def _kept(found: Evaluation, out: Path) -> dict[str, Any]:
    """Rows and void trials that ``out`` has. Raises TaccorlError: they are of another policy, robot or scenes."""
    if not out.is_dir() or {path.name for path in out.iterdir()} <= {"trials"}:
        return {}
    if not is_stored(out):
        raise TaccorlError(
            f"--out={out}: holds files already; nothing was changed: give another folder or move it"
        )
    there, here = (
        json.loads(text)
        for text in (
            (out / SUMMARY_FILE).read_text("utf-8"),
            json.dumps(found.to_json()),
        )
    )
    void = there.get("robot", {}).pop("void", [])
    here["robot"].pop("void")
    for what in ("policies", "scenes", "robot"):
        if there.get(what) != here[what]:
            text = f"--out={out}: holds other {what}: {there.get(what)}, not {here[what]}; give another folder"
            raise TaccorlError(text)
    return {
        "rows": read_rows(out / ROWS_FILE) if there["scores"] else [],
        "robot": {**found.robot, "void": void},
    }
