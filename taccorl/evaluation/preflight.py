"""Preflight: compare a checkpoint with the environment before any rollout (task, cameras, pictures, state, touch, action, rate,
normalisation, robot).

The module does not import torch: the facts of a checkpoint are passed as ``PolicyFacts``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from taccorl.data.spec import find_spec, load_dataset_spec
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.actions import check_actions
from taccorl.sim.part_poses import PARTS_KEY
from taccorl.sim.spaces import IMAGE_KEYS, IMAGE_SHAPE, STATE_KEY, TACTILE_KEY
from taccorl.sim.task import tasks as known_tasks
from taccorl.sim.twin import CONTROL_HZ, TwinConfig

NOT_STATED = "not stated"
"""Text in place of a value that the checkpoint does not state."""
Verdict = Literal["same", "within", "chosen", "differs", "not stated"]
"""Whether policy and environment agree in a property. ``within``: one side contains the other, as limits contain the data and an
environment's cameras those that a policy uses. ``chosen``: they differ by the user's option, which is no error."""
_IMAGES = "observation.images."


@dataclass(frozen=True, kw_only=True)
class PolicyFacts:
    """Inputs and outputs of a policy as its checkpoint states them. A field is None if the checkpoint does not state it."""

    inputs: dict[str, tuple[int, ...]]
    """LeRobot key → shape; pictures (3, rows, columns)."""
    action_shape: tuple[int, ...] | None
    """Shape of an action, without batch and chunk."""
    fps: float | None = None
    """Rows per second of the training dataset."""
    robot_type: str | None = None
    action_names: tuple[str, ...] | None = None
    """Names of the values of an action, in their order."""
    touch_gain_per_count: float | None = None
    """Gain of touch: normalised reading = counts × gain."""
    touch_has_unit: bool = True
    """False: touch is normalised by the statistics of the training dataset, because that does not state its unit."""
    touch_layout: tuple[int, ...] | None = None
    """Number of pads, rows and columns."""
    ranges: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    """``action`` and ``observation.state`` → (low, high), each (14,): range of the training data, from the statistics with which
    the policy normalises: minimum and maximum; without them, the 1 % and 99 % quantiles."""
    instructions: tuple[str, ...] | None = None
    """Instructions of the training dataset."""
    pictures_in_training: str | None = None
    """Changes of the pictures in training, as text."""
    pictures_in_use: Mapping[str, str] = field(default_factory=dict)
    """``clear`` and ``randomised`` → how the policy sees such pictures, as text."""
    unnormalised: tuple[str, ...] = ()
    """Features that must be normalised, but whose statistics the checkpoint lacks."""


@dataclass(frozen=True)
class Check:
    """One line of the preflight: a property as the policy's checkpoint and the environment state it, and whether they agree."""

    what: str
    """Name of the property, such as ``state`` or ``rate``."""
    policy: str
    """Its value in the checkpoint, as text; ``NOT_STATED`` if absent."""
    environment: str
    """Its value in the environment, as text."""
    verdict: Verdict


def preflight(
    policy: PolicyFacts,
    twin: TwinConfig,
    *,
    tasks: Sequence[str] = (),
    pictures: str = "clear",
) -> list[Check]:
    """Compare checkpoint and environment; returns one ``Check`` per property: task, cameras, pictures, state, touch, part
    poses, other inputs, action, names, rate, normalisation and statistics. ``tasks``: names of the environment's tasks;
    none: they are not compared."""
    return [
        *_task(policy, tasks),
        _cameras(policy, twin),
        *_pictures(policy, pictures),
        _same(
            "state",
            _shape(policy.inputs.get(STATE_KEY)),
            _shape(ROBOT.action_low.shape),
            optional=True,
        ),
        *_touch(policy),
        *_parts(policy),
        *_other_inputs(policy),
        _same("action", _shape(policy.action_shape), _shape(ROBOT.action_low.shape)),
        *_names(policy),
        _same(
            "rate",
            NOT_STATED if policy.fps is None else f"{policy.fps:g} Hz",
            f"{CONTROL_HZ} Hz",
        ),
        *(
            _normalisation(policy, key)
            for key in ("action", STATE_KEY)
            if key in policy.ranges
        ),
        *_statistics(policy),
    ]


def refuse_differences(checks: Sequence[Check], policy: str) -> None:
    """Raise if any line of the preflight differs. Raises TaccorlError: a line differs; the message names each one with the
    values of both sides."""
    wrong = [c for c in checks if c.verdict == "differs"]
    if wrong:
        lines = "; ".join(
            f"{c.what}: {c.policy} in the checkpoint, {c.environment} in the environment"
            for c in wrong
        )
        raise TaccorlError(
            f"{policy} does not fit the environment: {lines}. Nothing was run"
        )


def _same(what: str, policy: str, environment: str, *, optional: bool = False) -> Check:
    """``optional``: the policy may do without."""
    if policy == NOT_STATED:
        return Check(
            what,
            "not used" if optional else policy,
            environment,
            "within" if optional else NOT_STATED,
        )
    return Check(
        what, policy, environment, "same" if policy == environment else "differs"
    )


def _shape(shape: tuple[int, ...] | None) -> str:
    return NOT_STATED if shape is None else " × ".join(map(str, shape))


def _task(policy: PolicyFacts, names: Sequence[str]) -> list[Check]:
    """A policy is of the tasks whose instructions its training dataset has. A sentence of no task of the twin, such as one of
    recordings, is shown, not judged."""
    if not names:
        return []
    here = ", ".join(names)
    if policy.instructions is None:
        return [Check("task", f"task {NOT_STATED}", here, NOT_STATED)]
    known, trained = (
        {known_tasks.get(name).instruction: name for name in known_tasks},
        set(policy.instructions),
    )
    there = ", ".join(known.get(text, f"“{text}”") for text in policy.instructions)
    wanted = {known_tasks.get(name).instruction for name in names}
    if wanted <= trained:
        return [Check("task", there, here, "same" if wanted == trained else "within")]
    return [
        Check("task", there, here, "differs" if trained <= known.keys() else NOT_STATED)
    ]


def _pictures(policy: PolicyFacts, pictures: str) -> list[Check]:
    if not any(key.startswith(_IMAGES) for key in policy.inputs):
        return []
    there, here = (
        policy.pictures_in_training,
        policy.pictures_in_use.get(pictures, pictures),
    )
    if there is None:
        return [Check("pictures", NOT_STATED, here, NOT_STATED)]
    verdict: Verdict = (
        "same" if there == here else "within" if pictures == "clear" else "chosen"
    )
    return [Check("pictures", there, here, verdict)]


def _cameras(policy: PolicyFacts, twin: TwinConfig) -> Check:
    """A camera that the policy does not use is no difference."""
    shapes = {
        k.removeprefix(_IMAGES): s
        for k, s in policy.inputs.items()
        if k.startswith(_IMAGES)
    }
    there = [camera.name for camera in twin.cameras if camera.name in ROBOT.cameras]
    rows, columns, _ = IMAGE_SHAPE
    wanted = dict.fromkeys(there, (3, rows, columns))
    fits = all(wanted.get(name) == shape for name, shape in shapes.items())

    def listed(sizes: Mapping[str, tuple[int, ...]]) -> str:
        return (
            ", ".join(f"{name} {s[-2]}×{s[-1]}" for name, s in sizes.items()) or "none"
        )

    verdict: Verdict = (
        "differs" if not fits else "same" if shapes == wanted else "within"
    )
    return Check("cameras", listed(shapes), listed(wanted), verdict)


def _touch(policy: PolicyFacts) -> list[Check]:
    spec = load_dataset_spec(find_spec("taccorl_bimanual"))
    feature, sensor = spec.features[TACTILE_KEY], spec.sensors[TACTILE_KEY]
    layout = (len(feature.pads), sensor.rows, sensor.columns)
    checks = [
        _same(
            "touch",
            _shape(policy.inputs.get(TACTILE_KEY)),
            _shape(feature.shape),
            optional=True,
        )
    ]
    if TACTILE_KEY in policy.inputs and not policy.touch_has_unit:
        checks.append(
            Check(
                "unit of touch",
                "statistics of its dataset",
                "counts above baseline",
                "differs",
            )
        )
    if TACTILE_KEY in policy.inputs and policy.touch_layout is not None:
        checks.append(
            _same("touch layout", _shape(policy.touch_layout), _shape(layout))
        )
    if TACTILE_KEY in policy.inputs and policy.touch_gain_per_count is not None:
        gains = (policy.touch_gain_per_count, sensor.gain_per_count)
        same = bool(np.isclose(*gains, rtol=1e-6))
        words = [f"counts × {gain:.6g}" for gain in gains]
        checks.append(
            Check("touch gain", words[0], words[1], "same" if same else "differs")
        )
    return checks


def _parts(policy: PolicyFacts) -> list[Check]:
    """Which parts there are, each task says; the policy compares names when its episodes begin."""
    if PARTS_KEY not in policy.inputs:
        return []
    return [
        Check(
            "poses of the parts",
            _shape(policy.inputs[PARTS_KEY]),
            "those of each task",
            "same",
        )
    ]


def _other_inputs(policy: PolicyFacts) -> list[Check]:
    known = {STATE_KEY, TACTILE_KEY, PARTS_KEY, *IMAGE_KEYS.values()}
    others = [k for k in policy.inputs if k not in known and not k.startswith(_IMAGES)]
    return (
        [Check("other inputs", ", ".join(others), "none", "differs")] if others else []
    )


def _names(policy: PolicyFacts) -> list[Check]:
    spec = load_dataset_spec(find_spec("taccorl_bimanual"))
    names = tuple(spec.features["action"].names or ())
    checks = [_same("robot", policy.robot_type or NOT_STATED, spec.robot_type)]
    if policy.action_names is not None:
        same = policy.action_names == names
        words = [", ".join(those) for those in (policy.action_names, names)]
        words = ["as the environment", f"{names[0]} … {names[-1]}"] if same else words
        checks.append(
            Check("action names", words[0], words[1], "same" if same else "differs")
        )
    return checks


def _normalisation(policy: PolicyFacts, key: str) -> Check:
    """Compare the data limits of the checkpoint with the joint limits [rad] and openings [m]: other units lie far beyond them."""
    low, high = policy.ranges[key]
    there = f"{ROBOT.action_low.min():.3g} … {ROBOT.action_high.max():.3g} rad, grippers to {ROBOT.opening_max_m:.3g} m"
    here = f"{low.min():.3g} … {high.max():.3g}"
    fits = low.shape == high.shape == ROBOT.action_low.shape
    if fits:
        try:
            check_actions(np.stack([low, high]).astype(float))
        except TaccorlError:
            fits = False
    return Check(f"range of {key}", here, there, "within" if fits else "differs")


def _statistics(policy: PolicyFacts) -> list[Check]:
    if not policy.unnormalised:
        return []
    missing = f"no statistics of {', '.join(policy.unnormalised)}"
    return [Check("normalisation", missing, "needs statistics", "differs")]
