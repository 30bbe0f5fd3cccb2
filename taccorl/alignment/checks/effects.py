"""Checks of rules for every effect, without a simulation of the robot. Tests of an outside package's effects call them.

    check_effect(MyEffect)    # raises AssertionError with the rule that is violated

Effects with ``drive`` run in the one-joint model, effects with ``reading`` on a small pad that is pressed, held and released.
The project's own tests of registered effects (``tests/sim/effects/test_every_effect.py``) run the whole robot in addition.
"""

import copy
import math
from typing import Any

import numpy as np

from taccorl.alignment.controller.drive_numbers import Drive
from taccorl.alignment.controller.joint_kernel import simulate
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects.effect import NEEDS, Effect, TouchEffect

NEARLY, MOST = 0.01, 0.1
"""An effect at the first share of the way from absent to typical values may change the result by at most the second share of
what the typical values change."""
SCAN_S = 0.01  # Time between two scans of the pad in these checks [s]


def check_effect(cls: type[Effect]) -> None:
    """Check that an effect is described, bounded, absent at its absent values, present at its typical ones, and fades out. Raises
    AssertionError: a rule is violated; the message states the rule and the numbers."""
    _check_described(cls)
    absent, typical = cls(), cls(**_typical(cls))
    assert absent.is_absent, f"{cls.name}: built with its defaults it is not absent"
    assert not typical.is_absent, f"{cls.name}: at its typical values it is absent"
    runs = [
        run
        for run in (_joint, _pad)
        if run(absent) is not None and run(typical) is not None
    ]
    assert runs, (
        f"{cls.name}: it has neither drive() nor reading(); its test must run the robot (tests/sim/effects)"
    )
    for run in runs:
        nothing, there, nearly = (
            run(e) for e in (None, typical, cls(**_nearly_absent(cls)))
        )
        assert nothing is not None and there is not None and nearly is not None
        if run is _joint:  # touch effects that are absent are never called
            np.testing.assert_array_equal(
                run(absent),
                nothing,
                err_msg=f"{cls.name}: its absent numbers do something",
            )
        strong, weak = (
            float(np.sqrt(np.mean(np.square(x - nothing)))) for x in (there, nearly)
        )
        assert strong > 1e-6, f"{cls.name}: its typical values do nothing"
        assert weak <= MOST * strong + 1e-9, (
            f"{cls.name}: near its absent values it still does {weak / strong:.0%} of what its typical values do"
        )


def _check_described(cls: type[Effect]) -> None:
    assert cls.__doc__ and cls.equation, f"{cls.name}: give a docstring and an equation"
    for field in ("in_words", "at_a_policy", "to_record"):
        assert getattr(cls, field).endswith("."), (
            f"{cls.name}: {field} must be a sentence"
        )
    assert cls.needs, f"{cls.name}: give needs, of {', '.join(NEEDS)}"
    for p in cls.parameters():
        assert p.low <= p.typical <= p.high, (
            f"{cls.name}: {p.name}: typical {p.typical:g} is outside its bounds"
        )
        assert p.absent != p.typical, (
            f"{cls.name}: {p.name}: its typical value is the absent one"
        )
        assert p.symbol and p.source, f"{cls.name}: {p.name}: give symbol and source"
        outside: dict[str, Any] = {p.name: p.high + 0.01 * (p.high - p.low)}
        try:
            cls(**outside)
        except TaccorlError:
            continue
        raise AssertionError(
            f"{cls.name}: {p.name} = {outside[p.name]:g} is beyond its bounds, but was not rejected"
        )
    for start in cls.starts({}):
        values: dict[str, Any] = _typical(cls) | start
        assert not cls(**values).is_absent, (
            f"{cls.name}: a search would start at {start}: absent"
        )


def _typical(cls: type[Effect]) -> dict[str, Any]:
    return {p.name: p.typical for p in cls.parameters()}


def _nearly_absent(cls: type[Effect]) -> dict[str, Any]:
    values = _typical(cls)
    for p in cls.parameters():
        if p.absent is not None:
            values[p.name] = (
                p.absent + NEARLY * (p.typical - p.absent)
                if math.isfinite(p.absent)
                else p.high
            )
    return values


def _joint(effect: Effect | None) -> np.ndarray | None:
    """(200,) rad: a second of a joint with a part of its weight, sent by ± 0.4 rad; None if the effect has no numbers for it."""
    numbers = {} if effect is None else effect.drive()
    if numbers is None or (effect is not None and not numbers):
        return None
    unknown = [key for key in numbers if key not in Drive._fields]
    assert not unknown, (
        f"drive() gives {unknown[0]!r}, which taccorl.alignment.controller.drive_numbers.Drive lacks"
    )
    drive = Drive(
        kp=151.0,
        kd=17.0,
        torque_ff=1.7,
        inertia=0.2,
        gravity_sin=2.0,
        compensation_sin=1.5,
    )
    target = 0.5 + 0.4 * np.sin(2 * np.pi * 3.0 * np.arange(200) / 200)
    ones, none = np.ones(200), np.zeros(200)
    return simulate(
        drive._replace(**numbers),
        target,
        none,
        none,
        ones,
        ones,
        none,
        0.5,
        6,
        1,
        1 / 1200,
        0.0,
    )[0]


def _pad(effect: Effect | None) -> np.ndarray | None:
    """(T, P, R, C) readings of pads: a ramp, a hold, the release, and a rest; None if the effect does not change readings."""
    if effect is not None and (
        not isinstance(effect, TouchEffect) or type(effect).reading is Effect.reading
    ):
        return None
    force = np.interp(
        np.arange(0, 4.0, SCAN_S), [0.5, 1.0, 2.5, 2.8], [0.0, 4.0, 4.0, 0.0]
    )
    along, across = (np.square(np.linspace(-2, 2, n)) for n in ROBOT.pad.shape)
    bump = np.exp(-along[:, None] - across)
    ideal = (
        force[:, None, None, None] * bump * np.ones((len(ROBOT.pads), 1, 1))
    ).astype(np.float32)
    if effect is None:
        return ideal
    memory = copy.deepcopy(effect.memory(1, ROBOT.pad.shape))
    times_s = np.arange(len(ideal)) * SCAN_S
    steps_s, rows = (
        np.diff(times_s, prepend=0.0),
        [slice(k, k + 1) for k in range(len(ideal))],
    )
    return np.concatenate(
        [effect.reading(ideal[k], memory, times_s[k], steps_s[k]) for k in rows]
    )
