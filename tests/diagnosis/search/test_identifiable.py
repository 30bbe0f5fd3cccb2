"""What positions identify: ratios to K_p. A joint is simulated here by a loop of its own (sampled, speed filtered), which the
twin does not have; the twin's model is fitted to it. Not a robot."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import pytest
from made_problem import MadeProblem
from made_rows import of_joint
from one_joint import AxisJoint

from taccorl.alignment.controller.joint_model import JointModel
from taccorl.alignment.controller.rigid_joint import Gains
from taccorl.alignment.measurements.correlation import Rows
from taccorl.diagnosis.search.fit import FINE, Fit, fit
from taccorl.diagnosis.search.identifiable import (
    OVER_KP,
    POSITION_AGE_S,
    TIMING_S,
    Identified,
    absolute_numbers,
    identifiable_numbers,
    identified_value,
)
from taccorl.diagnosis.search.problem import Candidate, Free, Recording, candidate
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.effects.effect import Effect, JointEffect

J_KGM2, RATE_HZ, NOISE_RAD = 0.08, 200.0, 1e-4
TRUTH = {"kp": 151.0, "kd": 12.0, "torque_ff": 0.5, "coulomb_friction.torque_nm": 0.4}
SEEN = {
    "peak_torque_nm": 5.0,
    "peak_motor_nm": 5.0,
    "peak_speed_rad_per_s": 2.0,
    "span_rad": 0.6,
    "duration_s": 5.0,
}


class OneJoint(MadeProblem):
    """The twin's joint without weight."""

    base: tuple[Free, ...] = (
        Free(name="kp", unit="N·m/rad", start=200.0, low=1.0, high=1e5, log=True),
        Free(name="kd", unit="N·m·s/rad", start=20.0, low=0.1, high=1e3, log=True),
        Free(name="torque_ff", unit="N·m", start=0.0, low=-40.0, high=40.0),
    )

    def __init__(self, *names: str) -> None:
        self.candidates: dict[str, Candidate] = {
            name: candidate(effects.get(name), SEEN) for name in names
        }
        self.model = JointModel(
            AxisJoint("left_joint5", J_KGM2, gains=Gains(151.0, 12.0, 0.5))
        )

    def simulate(
        self, base: Mapping[str, float], effects: Sequence[Effect], recording: Recording
    ) -> np.ndarray:
        gains = Gains(
            base.get("kp", TRUTH["kp"]), base.get("kd", TRUTH["kd"]), base["torque_ff"]
        )
        return self.model.simulate(recording.data, gains, effects).reported[:, None]


def sampled_loop(
    target: np.ndarray, loop_hz: float, filter_s: float, coulomb_nm: float = 0.0
) -> np.ndarray:
    """(T,) rad: J q̈ = τ − F sign q̇ in steps of 1/8000 s, τ held for a period of the loop, speed by differences and a low-pass."""
    step_s, period_s = 1.0 / 8000.0, 1.0 / loop_hz
    every = round(8000.0 / loop_hz)
    q = last = TRUTH["torque_ff"] / TRUTH["kp"]
    v = speed = torque = 0.0
    angles = np.empty(len(target))
    for k in range(40 * len(target)):
        row, within = divmod(k, 40)
        if within == 0:
            angles[row] = q
        if k % every == 0:
            speed += ((q - last) / period_s - speed) * period_s / (filter_s + period_s)
            last = q
            torque = (
                TRUTH["kp"] * (float(target[row]) - q)
                - TRUTH["kd"] * speed
                + TRUTH["torque_ff"]
            )
        v += step_s * torque / J_KGM2
        brake = step_s * coulomb_nm / J_KGM2
        v -= min(max(v, -brake), brake)
        q += step_s * v
    return angles


def swept(loop_hz: float, filter_s: float, coulomb_nm: float) -> Recording:
    time_s = np.arange(round(5.0 * RATE_HZ)) / RATE_HZ
    angle = 2 * np.pi * (0.2 * time_s + 1.3 * time_s**2 / 10.0)
    target = (
        0.3
        * np.sin(angle)
        * np.clip(np.minimum(time_s - 0.3, 5.0 - time_s) / 0.5, 0.0, 1.0)
    )
    measured = sampled_loop(target, loop_hz, filter_s, coulomb_nm)
    measured += NOISE_RAD * np.random.default_rng(0).standard_normal(len(time_s))
    motion = of_joint(
        "swept", RATE_HZ, target, measured, start=TRUTH["torque_ff"] / TRUTH["kp"]
    )
    numbers = {
        "measured": measured[:, None],
        "floor": np.array([NOISE_RAD]),
        "data": motion,
    }
    return Recording(
        name="swept", time_s=time_s, channels=("left_joint5 [rad]",), **numbers
    )


def fitted(recording: Recording, *names: str) -> Fit:
    problem = OneJoint(*names)
    starts = {
        k: v for name in names for k, v in problem.candidates[name].starts[1].items()
    }
    return fit(
        problem,
        [recording],
        names,
        fit(problem, [recording], names, starts, 60).values,
        60,
        FINE,
    )


def named(numbers: Sequence[Identified]) -> dict[str, Identified]:
    return {n.name: n for n in numbers}


@pytest.mark.parametrize(
    ("loop_hz", "filter_s"),
    [(8000.0, 0.0), (4000.0, 5e-4), (1000.0, 1e-3), (500.0, 0.0)],
)
def test_friction_over_stiffness_is_right_where_the_loop_s_timing_spoils_the_torque(
    loop_hz: float, filter_s: float
):
    """s = J / (J − K_d τ) with τ = filter + period: 1.019, 1.127, 1.429; at 500 Hz higher orders of τ make it 1.29."""
    model = fitted(
        swept(loop_hz, filter_s, TRUTH["coulomb_friction.torque_nm"]),
        "coulomb_friction",
    )
    assert model.error < 1.1
    s = J_KGM2 / (J_KGM2 - TRUTH["kd"] * (filter_s + 1.0 / loop_hz))
    if loop_hz > 500.0:
        assert model.values["kp"] / TRUTH["kp"] == pytest.approx(s, rel=0.02)
        assert model.values["coulomb_friction.torque_nm"] / 0.4 == pytest.approx(
            s, rel=0.03
        )
    found = named(identifiable_numbers(model, commanded=False, effort=False))
    assert list(found) == ["kd/kp", "torque_ff/kp", "coulomb_friction.torque_nm/kp"]
    assert [n.unit for n in found.values()] == ["s", "rad", "rad"]
    for n in found.values():
        truth = identified_value(n.name, TRUTH)
        assert n.value == pytest.approx(truth, rel=0.02 if n.name == "kd/kp" else 0.01)
        if loop_hz > 500.0:
            assert n.low <= truth <= n.high, n
    friction = found["coulomb_friction.torque_nm/kp"]
    assert friction.high / friction.low < 1.05
    absolute = named(absolute_numbers(model, inertia_kgm2=J_KGM2, pinned=False))
    for name, n in absolute.items():
        assert n.low <= TRUTH[name] <= n.high, n
    low, high = model.intervals()["coulomb_friction.torque_nm"]
    if s > 1.1:
        assert not low <= TRUTH["coulomb_friction.torque_nm"] <= high, (
            "noise alone would be a false claim"
        )
    pinned = named(absolute_numbers(model, inertia_kgm2=J_KGM2, pinned=True))
    assert (
        pinned["coulomb_friction.torque_nm"].low,
        pinned["coulomb_friction.torque_nm"].high,
    ) == (low, high)


def made_fit(
    frees: Sequence[Free],
    values: dict[str, float],
    jacobian: np.ndarray,
    *names: Effect,
) -> Fit:
    """Noise of one floor, so that the covariance is (JᵀJ)⁻¹ but for the noise's own scatter."""
    rng = np.random.default_rng(0)
    residuals = rng.choice([-1.0, 1.0], len(jacobian))
    layout = (Rows(np.ones((len(jacobian), 1), bool), 200.0),)
    return Fit(
        names=tuple(e.name for e in names),
        values=values,
        residuals=residuals,
        layout=layout,
        jacobian=jacobian,
        frees=tuple(frees),
        at_bound=(),
        trouble="",
        effects=names,
    )


def test_variance_of_a_ratio_is_that_of_the_difference_of_logarithms():
    """log F and log K_p moved by a common factor nothing is measured of: each interval is wide, that of F / K_p is not."""
    rng = np.random.default_rng(1)
    common, apart = rng.standard_normal((2, 1500))
    # residual = 1e-3 common (f + k) + 10 apart (f − k): columns of the Jacobian by k, kd, T_ref, f
    others = rng.standard_normal((2, 1500))
    jacobian = np.column_stack(
        [1e-3 * common - 10.0 * apart, *others, 1e-3 * common + 10.0 * apart]
    )
    problem = OneJoint("coulomb_friction")
    frees = (*problem.base, problem.candidates["coulomb_friction"].frees[0])
    effect = make_effect(
        "coulomb_friction", torque_nm=0.4, arm="left", joints=["joint5"]
    )
    model = made_fit(frees, dict(TRUTH), jacobian, effect)
    covariance = model.covariance()
    spread = 1.96 * np.sqrt(covariance[0, 0] + covariance[3, 3] - 2 * covariance[0, 3])
    n = named(identifiable_numbers(model, commanded=False, effort=False))[
        "coulomb_friction.torque_nm/kp"
    ]
    assert n.value == pytest.approx(0.4 / 151.0)
    assert np.log(n.high / n.value) == pytest.approx(spread, rel=1e-6)
    assert np.log(n.value / n.low) == pytest.approx(spread, rel=1e-6)
    assert spread < 0.01 < 10 < 1.96 * np.sqrt(covariance[3, 3])


def test_known_gains_and_efforts_make_the_absolute_numbers_primary():
    model = fitted(swept(8000.0, 0.0, 0.4), "coulomb_friction")
    with_effort = named(identifiable_numbers(model, commanded=False, effort=True))
    assert {"kd/kp", "torque_ff/kp", "coulomb_friction.torque_nm/kp"} <= set(
        with_effort
    )
    assert "coulomb_friction.torque_nm" in with_effort
    assert not {"kp", "kd", "torque_ff"} & set(with_effort), (
        "loops that are sampled shift them"
    )
    known = OneJoint("coulomb_friction")
    known.base = known.base[2:]
    recording = swept(8000.0, 0.0, 0.4)
    own = known.simulate(
        TRUTH, [make_effect("coulomb_friction", torque_nm=0.4)], recording
    )  # in the twin's own loop
    recording.measured[:] = own + NOISE_RAD * np.random.default_rng(3).standard_normal(
        own.shape
    )
    commanded = fit(known, [recording], ["coulomb_friction"], {"torque_ff": 0.5})
    found = named(identifiable_numbers(commanded, commanded=True, effort=False))
    assert list(found) == ["torque_ff", "coulomb_friction.torque_nm"]
    assert (
        found["coulomb_friction.torque_nm"].low
        <= 0.4
        <= found["coulomb_friction.torque_nm"].high
    )


def test_an_effect_that_is_absent_at_one_is_counted_from_there():
    """Weight carried s = 0.9 times: (0.9 − 1) / 200 rad per N·m of weight."""
    values = {"kp": 200.0, "gravity_mismatch.share": 0.9}
    assert identified_value("gravity_mismatch.(share-1)/kp", values) == pytest.approx(
        -5e-4
    )
    assert identified_value("backlash.play_rad", {"backlash.play_rad": 0.01}) == 0.01
    with pytest.raises(KeyError):
        identified_value("kd/kp", {"kp": 1.0})


def test_an_inertia_is_known_to_the_loop_s_timing():
    """(J + ΔJ − K_d τ) q̈: with known gains ΔJ may be K_d τ_max greater than it looks."""
    c = candidate(effects.get("armature"), SEEN)
    effect = make_effect("armature", added_kgm2=0.05, arm="left", joints=["joint5"])
    values = {"torque_ff": 0.5, "armature.added_kgm2": 0.05}
    jacobian = np.random.default_rng(2).standard_normal((500, 2))
    model = made_fit((OneJoint.base[2], *c.frees), values, jacobian, effect)
    (n,) = [
        n
        for n in identifiable_numbers(model, True, False, kd=12.0)
        if n.name.startswith("armature")
    ]
    assert n.high == pytest.approx(
        model.intervals()["armature.added_kgm2"][1] + 12.0 * TIMING_S
    )
    assert POSITION_AGE_S < TIMING_S


def test_every_torque_stiffness_damping_and_mass_of_a_joint_is_marked_as_over_kp():
    """By its unit: the equation of motion divided by K_p has no other unit with N·m or kg in it."""
    for name in effects:
        cls = effects.get(name)
        for p in cls.parameters():
            if p.over:
                assert p.unit in OVER_KP, (name, p.name)
            force = p.unit in OVER_KP and p.unit != "1"
            if issubclass(cls, JointEffect) and force:
                assert p.over == "kp", (name, p.name)
    assert effects.get("payload").parameters()[0].over == "kp"
    assert effects.get("gravity_mismatch").parameters()[0].over == "kp"
    assert (
        dataclasses.replace(
            effects.get("coulomb_friction").parameters()[0], over=""
        ).over
        == ""
    )


def test_a_number_that_nothing_but_its_bounds_holds_is_not_identified():
    """Of 1/3 … 3 times 1.5 the residuals say nothing: a slope a million times less than that of the first."""
    frees = [
        Free(name="torque_ff", unit="N·m", start=0.0, low=-40.0, high=40.0),
        Free(name="stall_nm", unit="N·m", start=1.5, low=0.5, high=4.5, log=True),
    ]
    slopes = np.random.default_rng(1).standard_normal((4000, 2)) * [1.0, 1e-6]
    found = identifiable_numbers(
        made_fit(frees, {"torque_ff": 0.5, "stall_nm": 1.5}, slopes),
        commanded=True,
        effort=False,
    )
    assert [n.name for n in found] == ["torque_ff"]


def test_where_nothing_determines_the_damping_a_torque_s_interval_takes_the_end_of_its_range():
    """K_p = 151 may be 1 + K_d τ_max / J times less than it looks: here with K_d = 1000 N·m·s/rad, the upper bound."""
    slopes = np.random.default_rng(1).standard_normal((4000, 3)) * [1.0, 1e-9, 1.0]
    model = made_fit(
        OneJoint.base, {name: TRUTH[name] for name in ("kp", "kd", "torque_ff")}, slopes
    )
    found = named(absolute_numbers(model, inertia_kgm2=J_KGM2, pinned=False))
    assert set(found) == {"kp", "torque_ff"}
    kp = model.intervals()["kp"]
    assert found["kp"].low == pytest.approx(
        kp[0] / (1.0 + 1e3 * TIMING_S / J_KGM2), rel=1e-6
    )
