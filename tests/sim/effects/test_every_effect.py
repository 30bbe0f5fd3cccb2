"""What holds for every registered effect, those of outside packages too: absent means absent, and present is reproducible."""

import functools
import math
import re
from typing import Any

import numpy as np
import pytest
from press_bench import perform, start

from taccorl.alignment.controller.drive_numbers import Drive
from taccorl.alignment.controller.joint_kernel import simulate
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.effects.effect import TOUCH_SLOTS, ArmEffect, Effect

BASE = ("kp", "kd", "torque_ff", "k_n", "k_d")  # Numbers that are always fitted
SEEN = ("reported", "hands", "reading")
UNITS = {
    "_nms2_per_rad2": "N·m·s²/rad²",
    "_nms_per_rad": "N·m·s/rad",
    "_nm_per_rad": "N·m/rad",
    "_rad_per_nm": "rad/(N·m)",
    "_rad_per_s": "rad/s",
    "_per_s": "1/s",
    "_per_min": "1/min",
    "_per_k": "1/K",
    "_kgm2": "kg·m²",
    "_nm": "N·m",
    "_kg": "kg",
    "_px": "px",
    "_rad": "rad",
    "_m": "m",
    "_s": "s",
}


def typical(cls: type[Effect]) -> dict[str, Any]:
    return {p.name: p.typical for p in cls.parameters()}


def nearly_absent(cls: type[Effect]) -> dict[str, Any]:
    """A hundredth of the way from absent to typical."""
    values = typical(cls)
    for p in cls.parameters():
        if p.absent is not None:
            values[p.name] = (
                p.absent + 0.01 * (p.typical - p.absent)
                if math.isfinite(p.absent)
                else p.high
            )
    return values


@functools.cache
def nominal() -> dict[str, np.ndarray]:
    return perform(start())


def difference(
    seen: dict[str, np.ndarray], other: dict[str, np.ndarray]
) -> dict[str, float]:
    """Root mean square over the run."""
    return {
        name: float(np.sqrt(np.mean(np.square(seen[name] - other[name]))))
        for name in SEEN
    }


ONE_OF_FOUR = [
    pytest.param(name, marks=[pytest.mark.slow] * (k % 4 > 0))
    for k, name in enumerate(effects)
]
"""All effects; three of four are slow."""


def shows_in_a_run(name: str) -> bool:
    cls = effects.get(name)
    return cls.slot != "camera" and not {"temperature", "dry_friction"} & {*cls.needs}


def check_fades_out(cls: type[Effect]) -> None:
    """It does something at typical values, and at most a tenth of that a hundredth of the way from its absent values."""
    there = difference(perform(start(cls(**typical(cls)))), nominal())
    nearly = difference(perform(start(cls(**nearly_absent(cls)))), nominal())
    assert max(there.values()) > 1e-5
    for name in SEEN:
        assert nearly[name] <= 0.1 * there[name] + 1e-9, (name, nearly, there)


@pytest.mark.parametrize("name", list(effects))
def test_an_absent_effect_leaves_the_run_bit_identical(name: str) -> None:
    cls = effects.get(name)
    shape = [p for p in cls.parameters() if p.absent is None]
    lows: dict[str, Any] = {p.name: p.low for p in shape}
    highs: dict[str, Any] = {p.name: p.high for p in shape}
    variants: list[dict[str, Any]] = [{}, lows, highs]
    for variant in variants if shape else variants[:1]:
        effect = cls(**variant)
        assert effect.is_absent
        seen = perform(start(effect))
        for kind, values in nominal().items():
            np.testing.assert_array_equal(
                seen[kind], values, err_msg=f"{name} {variant}: {kind}"
            )


# What cameras show fades out in test_camera_effects.py; a run has no temperature: tests/diagnosis/problems/test_cells_problem.py;
# and joints of the nominal twin have no dry friction: tests/alignment/controller/test_joint_model.py.
@pytest.mark.parametrize(
    "name", [p for p in ONE_OF_FOUR if shows_in_a_run(str(p.values[0]))]
)
def test_an_effect_fades_out_towards_its_absent_value(name: str) -> None:
    check_fades_out(effects.get(name))


@pytest.mark.parametrize("name", ONE_OF_FOUR)
def test_at_its_bounds_the_twin_stays_sound(name: str) -> None:
    cls = effects.get(name)
    for p in cls.parameters():
        for bound in (p.low, p.high):
            sim = start(make_effect(name, **typical(cls) | {p.name: bound}))
            seen = perform(sim, last=6)
            assert not sim.diverged.any(), f"{p.name} = {bound}"
            assert np.isfinite(seen["reading"]).all()
            beyond = np.maximum(
                seen["reported"] - ROBOT.action_high,
                ROBOT.action_low - seen["reported"],
            )
            assert beyond.max() < 0.25, f"{p.name} = {bound}"


@pytest.mark.parametrize("name", ONE_OF_FOUR)
def test_a_run_is_the_same_alone_and_in_a_batch_on_any_number_of_threads_and_from_a_snapshot(
    name: str,
) -> None:
    effect = effects.get(name)(**typical(effects.get(name)))
    alone = perform(start(effect))
    batch = start(effect, num_sims=3, num_threads=2)
    begun = perform(batch, last=6)
    snapshot = batch.snapshot()
    ended = perform(batch, 6)
    for kind, values in alone.items():
        together = np.concatenate([begun[kind], ended[kind]])
        np.testing.assert_array_equal(
            together[:, 0], values[:, 0], err_msg=f"batch: {kind}"
        )
    other = start(effect, num_sims=3)
    perform(other, last=2)
    other.restore(snapshot)
    for kind, values in perform(other, 6).items():
        np.testing.assert_array_equal(values, ended[kind], err_msg=f"restored: {kind}")


@pytest.mark.parametrize("name", list(effects))
def test_parameters_are_described(name: str) -> None:
    cls = effects.get(name)
    assert cls.name == name and cls.__doc__
    assert any(p.absent is not None for p in cls.parameters())
    assert not [p.name for p in cls.parameters() if ROBOT.hand in p.name], (
        "names hold for any robot"
    )
    for p in cls.parameters():
        assert p.low <= p.typical <= p.high
        assert p.absent is None or p.low <= p.absent <= p.high or math.isinf(p.absent)
        assert p.absent != p.typical and p.symbol
        assert p.source
        of_reading = (
            p.unit.replace("reading", "1") if "reading" in cls.needs else p.unit
        )
        unit = next(
            (unit for suffix, unit in UNITS.items() if p.name.endswith(suffix)), "1"
        )
        assert of_reading == unit, f"{p.name} in {p.unit}"
        low, high = cls.accepted(p)
        assert low <= p.low and p.high <= high
        outside = high + 0.01 * (high - low)
        with pytest.raises(
            TaccorlError, match=rf"{name}: {p.name} is .* outside of .*{high:g}"
        ):
            make_effect(name, **{p.name: outside})


@pytest.mark.parametrize("name", list(effects))
def test_an_effect_says_what_it_is_and_what_it_may_be_mistaken_for(name: str) -> None:
    cls = effects.get(name)
    assert all(
        (
            cls.equation,
            cls.in_words,
            cls.at_a_policy,
            cls.to_record,
            *cls.near_twins.values(),
        )
    )
    if "joint" in cls.kinds():  # of a slide, too
        words = " ".join((cls.at_a_policy, cls.to_record, *cls.near_twins.values()))
        assert not {"arm", "arms", "hand"} & {*re.findall(r"\w+", words.lower())}
    for other in cls.near_twins:
        assert other != name
        assert other in BASE or name in effects.get(other).near_twins, (
            f"{name}: {other} does not name it"
        )


@pytest.mark.parametrize("name", list(effects))
def test_a_search_starts_within_bounds_with_the_effect_there(name: str) -> None:
    cls = effects.get(name)
    for peak_torque, peak_speed, span in (
        (3.0, 0.6, 0.7),
        (0.0, 0.0, 0.0),
        (1e4, 1e4, 6.0),
    ):
        seen = {
            "peak_torque_nm": peak_torque,
            "peak_speed_rad_per_s": peak_speed,
            "span_rad": span,
            "duration_s": 10.0,
        }
        starts = cls.starts(seen)
        assert 1 <= len(starts) <= 130
        for values in starts:
            assert values.keys() <= {p.name for p in cls.parameters()}
            assert not make_effect(name, **typical(cls) | values).is_absent


@pytest.mark.parametrize(
    "name",
    [
        name
        for name in effects
        if effects.get(name).slot not in (*TOUCH_SLOTS, "camera")
    ],
)
def test_the_one_joint_model_takes_every_number_that_an_effect_gives_it(
    name: str,
) -> None:
    """An absent effect's numbers do nothing there, and its typical ones do something; of bodies MuJoCo tells."""
    cls = effects.get(name)
    drive, absent = cls(**typical(cls)).drive(), cls().drive()
    if not drive or absent is None:
        assert drive is None or issubclass(cls, ArmEffect), (
            f"{name} changes a body; only an arm has some"
        )
        return
    unknown = [key for key in drive if key not in Drive._fields]
    assert not unknown
    assert all(isinstance(value, float) for value in drive.values())
    own = {"coulomb_friction__torque_nm": 1.0} if "dry_friction" in cls.needs else {}
    np.testing.assert_array_equal(one_joint(**own, **absent), one_joint(**own))
    assert np.abs(one_joint(**own, **drive) - one_joint(**own)).max() > 1e-6
    for (
        key,
        value,
    ) in (
        drive.items()
    ):  # a field that nothing reads would be taken for another one by numba's cache
        assert (
            one_joint(
                **own,
                **drive | {key: 0.7 * value + (1.0 if key.endswith("seed") else 0.01)},
            )
            != one_joint(**own, **drive)
        ).any(), key


def one_joint(**numbers: float) -> np.ndarray:
    """(200,) rad: a second of a joint with a part of its weight that is sent by ± 0.4 rad and takes 12 N·m, a row each 5 ms."""
    drive = Drive(
        151.0, 17.0, 1.7, inertia=0.2, gravity_sin=2.0, compensation_sin=1.5
    )._replace(**numbers)
    target = 0.5 + 0.4 * np.sin(2 * np.pi * 3.0 * np.arange(200) / 200)
    none, ones = np.zeros(200), np.ones(200)
    return simulate(
        drive, target, none, none, ones, ones, none, 0.5, 6, 1, 1 / 1200, 0.0
    )[0]
