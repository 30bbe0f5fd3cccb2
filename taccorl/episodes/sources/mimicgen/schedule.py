"""Schedule of the arms' subtasks: a state machine that decides which arm makes which step next. No simulator, poses or time.

An arm does its subtasks in order. When one begins its trajectory is *planned*: how many steps it has, and how many of its last
ones run together with the other arm. Constraints hold an arm back; a held arm repeats its last target. If no arm can move
and none can be planned, a deadlock is reported.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from taccorl.errors import DeadlockError, TaccorlError

Place = tuple[str, int]
"""(arm, index of its subtask)."""


@dataclass(frozen=True, kw_only=True)
class ConstraintSpec:
    """Constraint between two subtasks: order, or execution at the same time."""

    eef_subtask_constraint_tuple: tuple[Place, Place]
    """Two of (arm, index of its subtask from 0); for a sequence the former first."""
    constraint_type: Literal["sequential", "coordination"]
    coordination_scheme: Literal["replay", "transform"] = "replay"
    """How both arms repeat one source demonstration. replay: as it was recorded; transform: moved by the displacement of the
    object of the subtask that begins first, from the source's scene to the new one."""
    coordination_synchronize_start: bool = False
    """True: both begin together, at the later of their first rows in the source. False: only their ends run together."""

    @property
    def former(self) -> Place:
        """Subtask that comes first, or one of the two of a coordination; ``latter`` is the other."""
        return self.eef_subtask_constraint_tuple[0]

    @property
    def latter(self) -> Place:
        return self.eef_subtask_constraint_tuple[1]

    @property
    def coordinated(self) -> bool:
        """True: both run at the same time, with aligned ends. False: one after the other."""
        return self.constraint_type == "coordination"


class Cue(NamedTuple):
    """What an arm does in the present control step: its subtask, and the index of the step in the subtask's trajectory."""

    subtask: int
    step: int
    """Index of the step in the subtask's trajectory."""


@dataclass
class _Arm:
    names: tuple[str, ...]
    subtask: int = 0
    step: int = 0
    num_steps: int | None = None
    """None: not planned yet."""
    num_together: int = 0

    @property
    def done(self) -> bool:
        return self.subtask == len(self.names)

    @property
    def name(self) -> str:
        return self.names[self.subtask] if not self.done else "nothing"


@dataclass
class Schedule:
    """Schedule of two arms: decides in each control step which arm makes the next step of its subtask, and which waits. Call
    ``to_plan``, then ``plan`` for each arm that it names, then ``tick``, until ``done``.
    """

    signals: Mapping[str, Sequence[str]]
    """Arm → names of its subtasks."""
    constraints: Sequence[ConstraintSpec] = ()
    _arms: dict[str, _Arm] = field(init=False)

    def __post_init__(self) -> None:
        self._arms = {arm: _Arm(tuple(names)) for arm, names in self.signals.items()}

    @property
    def done(self) -> bool:
        """True if every arm has ended its last subtask."""
        return all(arm.done for arm in self._arms.values())

    def subtask(self, arm: str) -> int:
        """Index of the arm's present subtask; the number of its subtasks when all have ended."""
        return self._arms[arm].subtask

    def upcoming(self, arm: str) -> Cue | None:
        """Next step of the arm; None if nothing is planned."""
        state = self._arms[arm]
        return None if state.num_steps is None else Cue(state.subtask, state.step)

    def to_plan(self) -> list[str]:
        """Names of the arms whose present subtask may begin and has no trajectory yet."""
        idle = [
            arm
            for arm, state in self._arms.items()
            if not state.done and state.num_steps is None
        ]
        return [arm for arm in idle if not self._kept_from_beginning(arm)]

    def plan(self, arm: str, num_steps: int, num_together: int = 0) -> None:
        """Set the length of the arm's present subtask: ``num_steps`` steps, the last ``num_together`` of them together with
        the other arm."""
        if num_steps < 1 or not 0 <= num_together <= num_steps:
            raise TaccorlError(
                f"schedule: {arm}: {num_together} of {num_steps} steps together: 0 … all, at least 1"
            )
        state = self._arms[arm]
        state.num_steps, state.step, state.num_together = num_steps, 0, num_together

    def tick(self, held: Collection[str] = ()) -> dict[str, Cue]:
        """Advance by one control step: returns arm → its step, for the arms that move. ``held`` are arms that must not move.
        Raises DeadlockError: no arm moves, and ``held`` is empty."""
        why = {arm: self._waits_for(arm) for arm in self._arms}
        moving = {
            arm
            for arm, state in self._arms.items()
            if not state.done and not why[arm] and arm not in held
        }
        for arm in list(moving):
            partner = self._partner(arm)
            if partner and partner not in moving and self._is_together(arm):
                moving.discard(arm)  # side by side: if one is held, so is the other
        if not moving and not self.done and not held:
            waits = "; ".join(f"{arm} {text}" for arm, text in why.items() if text)
            raise DeadlockError(f"deadlock: {waits}. Change task_constraint_configs.")
        cues = {}
        for arm in self._arms:
            if arm in moving:
                state = self._arms[arm]
                cues[arm] = Cue(state.subtask, state.step)
                state.step += 1
                if state.step == state.num_steps:
                    state.subtask, state.step, state.num_steps, state.num_together = (
                        state.subtask + 1,
                        0,
                        None,
                        0,
                    )
        return cues

    # ------------------------------------------------------------------------------------------------------------------

    def _kept_from_beginning(self, arm: str) -> str:
        """Why the arm's present subtask may not begin; empty if it may."""
        state = self._arms[arm]
        for c in self.constraints:
            if (
                c.latter == (arm, state.subtask)
                and not c.coordinated
                and not self._ended(c.former)
            ):
                return f"waits to begin {state.name!r} until {c.former[0]} has ended {self._name(c.former)!r}"
        c = self._coordination(arm)
        if (
            c
            and c.coordination_synchronize_start
            and not self._at(other := self._other(c, arm))
        ):
            return f"waits to begin {state.name!r} until {other[0]} begins {self._name(other)!r}"
        return ""

    def _waits_for(self, arm: str) -> str:
        """Why the arm does not move now; empty if nothing keeps it."""
        state = self._arms[arm]
        if state.done:
            return ""
        if state.num_steps is None:
            return (
                self._kept_from_beginning(arm) or f"has no trajectory of {state.name!r}"
            )
        if self._is_together(arm):
            c = self._coordination(arm)
            assert c is not None
            other = self._other(c, arm)
            if not (
                self._at(other) and self._is_together(other[0])
            ) and not self._ended(other):
                return f"waits in {state.name!r} for {other[0]} to come to its part of {self._name(other)!r}"
        return ""

    def _is_together(self, arm: str) -> bool:
        """Whether the arm is in the stretch of its subtask that runs at the partner's side."""
        state = self._arms[arm]
        in_it = (
            state.num_steps is not None
            and state.step >= state.num_steps - state.num_together
        )
        return in_it and self._coordination(arm) is not None

    def _partner(self, arm: str) -> str | None:
        """The arm that does its part of the same coordination now."""
        c = self._coordination(arm)
        other = self._other(c, arm) if c else None
        return other[0] if other and self._at(other) else None

    def _coordination(self, arm: str) -> ConstraintSpec | None:
        place = (arm, self._arms[arm].subtask)
        return next(
            (
                c
                for c in self.constraints
                if c.coordinated and place in (c.former, c.latter)
            ),
            None,
        )

    @staticmethod
    def _other(c: ConstraintSpec, arm: str) -> Place:
        return c.latter if c.former[0] == arm else c.former

    def _at(self, place: Place) -> bool:
        return self._arms[place[0]].subtask == place[1]

    def _ended(self, place: Place) -> bool:
        return self._arms[place[0]].subtask > place[1]

    def _name(self, place: Place) -> str:
        return self._arms[place[0]].names[place[1]]


def rehearse(
    signals: Mapping[str, Sequence[str]], constraints: Sequence[ConstraintSpec]
) -> None:
    """Run the schedule of ``signals`` (arm → names of its subtasks) with one step per subtask, to find deadlocks. Raises
    DeadlockError: the schedule cannot end, for any lengths of the subtasks."""
    schedule = Schedule(signals, constraints)
    while not schedule.done:
        for arm in schedule.to_plan():
            schedule.plan(arm, 1, 1)
        schedule.tick()
