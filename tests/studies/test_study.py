"""Arithmetic of the study on rows written by hand, and one real job."""

from typing import Any

import numpy as np
import pytest

from pipelines.studies import cells
from pipelines.studies.figures import (
    SLOPE,
    confusion_matrix,
    detection_curves,
    half_detected,
)
from pipelines.studies.joints_and_pads import (
    IDENTICAL,
    MATERIAL,
    Conditions,
    Job,
    conditions,
    drop_said,
    exact,
    exact_but_for_algebra,
    failed,
    inside,
    jobs,
    material,
    named,
    run,
    silently_wrong,
)
from taccorl.data.origin import Origin
from taccorl.sim.effects import effects
from taccorl.surrogate.hidden import KINDS


def row(
    hidden: tuple[str, ...], found: tuple[str, ...], **fields: Any
) -> dict[str, Any]:
    plain = {
        "status": "at_floor",
        "ties": {},
        "rivals": {},
        "errors": {"fitted": {"validation": 5.0}},
    }
    plain |= {"findings": [], "numbers": {}}
    return {"hidden": list(hidden), "found": list(found)} | plain | fields


def test_of_one_hidden_effect_the_first_one_found_must_be_it():
    assert exact(row(("backlash",), ("backlash",)))
    assert exact(row(("backlash",), ("backlash", "cogging")))
    assert not exact(row(("backlash",), ("cogging", "backlash")))
    assert not exact(row(("backlash",), ()))


def test_of_two_both_must_be_found_in_any_order():
    assert exact(row(("backlash", "cogging"), ("cogging", "slew_limit", "backlash")))
    assert not exact(row(("backlash", "cogging"), ("backlash",)))


def test_what_algebra_makes_one_counts_either_way():
    assert not exact(row(("coulomb_friction",), ("asymmetric_friction",)))
    assert exact_but_for_algebra(row(("coulomb_friction",), ("asymmetric_friction",)))
    assert exact_but_for_algebra(row(("sensor_delay",), ("command_delay",)))
    assert not exact_but_for_algebra(row(("coulomb_friction",), ("stribeck_friction",)))
    assert not exact_but_for_algebra(
        row(("coulomb_friction",), ("backlash", "asymmetric_friction"))
    )
    assert not exact_but_for_algebra(row(("coulomb_friction",), ()))
    both = ("coulomb_friction", "command_delay")
    assert exact_but_for_algebra(row(both, ("sensor_delay", "coulomb_friction")))
    assert not exact_but_for_algebra(
        row(both, ("coulomb_friction", "asymmetric_friction"))
    )  # one of them twice


def test_effects_that_are_one_by_algebra_call_each_other_near_twins():
    for group in IDENTICAL:
        for name in group:
            assert group - {name} <= set(effects.get(name).near_twins), (
                f"{name} does not name {group - {name}}"
            )


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (("backlash",), {}),
        (("cogging",), {"ties": {"cogging": ["backlash"]}}),
        (("cogging",), {"rivals": {"cogging": ["backlash"]}}),
    ],
)
def test_a_hidden_effect_is_named_in_any_of_these_ways(
    found: tuple[str, ...], said: dict[str, Any]
):
    assert named(row(("backlash",), found, **said))
    assert not silently_wrong(row(("backlash",), found, **said))


def test_a_near_twin_of_what_was_found_is_named():
    twin = next(t for t in effects.get("coulomb_friction").near_twins if t in effects)
    assert named(row((twin,), ("coulomb_friction",)))


def test_a_tie_of_an_effect_that_is_not_there_any_more_says_nothing():
    assert "backlash" not in effects.get("cogging").near_twins
    assert not named(
        row(("backlash",), ("cogging",), ties={"slew_limit": ["backlash"]})
    )


def test_silently_wrong_is_at_the_floor_with_another_effect_and_no_word_of_the_true_one():
    assert silently_wrong(row(("backlash",), ("cogging",)))
    assert not silently_wrong(row(("backlash",), ("cogging",), status="something_else"))
    # which says nothing of what is hidden
    assert silently_wrong(row(("backlash",), ("cogging",), status="gains_moved"))
    assert not silently_wrong(
        row(("backlash", "slew_limit"), ("slew_limit", "cogging"))
    )
    assert not silently_wrong(row(("backlash",), (), status="nothing_missing"))


def test_material_is_what_refitted_gains_leave():
    at = {
        "errors": {"fitted": {"validation": MATERIAL}, "before": {"validation": 99.0}}
    }
    below = {
        "errors": {
            "fitted": {"validation": MATERIAL - 0.01},
            "before": {"validation": 99.0},
        }
    }
    assert material(row((), (), **at)) and not material(row((), (), **below))


def test_a_near_twin_of_a_kind_outside_the_registry_is_named_and_another_effect_is_not():
    assert KINDS["magnetic_hysteresis"].near == (
        "coulomb_friction",
        "stribeck_friction",
    )
    assert named(row(("magnetic_hysteresis",), ("stribeck_friction",)))
    assert not named(row(("magnetic_hysteresis",), ("cogging",)))
    assert silently_wrong(row(("magnetic_hysteresis",), ("cogging",)))


def test_lost_commands_are_said_by_a_finding_or_an_effect():
    assert drop_said(
        row(("dropped_commands",), (), findings=["does_not_repeat", "dropped_commands"])
    )
    assert not drop_said(
        row(("dropped_commands",), ("backlash",), findings=["does_not_repeat"])
    )


def test_intervals_hold_the_truth_or_do_not():
    numbers = {
        "kd/kp": [0.1, 0.09, 0.11, 0.105],
        "backlash.play_rad": [0.01, 0.009, 0.011, 0.012],
    }
    r = row(("backlash",), ("backlash",), numbers=numbers)
    assert inside(r) == [True, False]
    assert inside(r, hidden_only=True) == [False]
    turned = row(
        ("cogging",),
        ("cogging",),
        numbers={"cogging.phase_rad": [-5.41, -5.64, -5.19, 1.03]},
    )
    assert inside(turned) == [True]  # 1.03 − 2 π = −5.25


def test_a_failed_case_is_material_so_that_it_counts():
    r = failed(
        Job(study="single", hidden=("cogging",), seed=1, design="pack"),
        "ValueError: no",
    )
    assert (
        material(r)
        and r["failed"] == "ValueError: no"
        and r["key"] == "single pack cogging seed 1"
    )


def test_every_condition_is_as_frequent_as_it_is_said_to_be():
    def share(of: list[Job], name: str) -> float:
        return sum(getattr(conditions(job), name) for job in of) / len(of)

    clean = jobs("none", "chirp", [""], range(20000, 20162))
    shares = [share(clean, n) for n in ("loaded", "sampled", "coloured", "effort")]
    assert shares == pytest.approx(
        [1 / 3] * 4, abs=0.01
    )  # efforts: half of the two thirds without a sampled loop
    assert not any(conditions(j).sampled and conditions(j).effort for j in clean)
    assert all(
        conditions(j).sampled and conditions(j).effort
        for j in jobs("loop", "chirp", [""], [1, 2])
    )
    hidden = jobs(
        "single", "pack", ["cogging", "backlash", "payload"], range(20000, 20016)
    )
    assert [share(hidden, n) for n in ("effort", "sampled", "coloured", "loaded")] == [
        0.5,
        0.5,
        0.25,
        0.0,
    ]
    both = {
        (conditions(j).effort, conditions(j).sampled)
        for j in jobs("single", "chirp", ["cogging"], range(4))
    }
    assert len(both) == 4  # every combination within four seeds
    assert conditions(clean[5]) == conditions(jobs("none", "pack", [""], [20005])[0])
    assert isinstance(conditions(clean[0]), Conditions)


def test_keys_tell_jobs_apart_and_are_the_same_for_the_same_job():
    assert (
        Job(study="single", hidden=("cogging",), seed=3, design="pack").key
        == "single pack cogging seed 3"
    )
    strong = Job(
        study="single", hidden=("cogging",), seed=3, design="pack", strength=2.0
    )
    assert strong.key == "single pack cogging at 2 seed 3"
    one, two = ["cogging", "backlash"], ["backlash+cogging", "cogging+backlash"]
    made = [
        *jobs("single", "chirp", one, [0, 1]),
        *jobs("single", "pack", one, [0, 1]),
        *jobs("none", "chirp", [""], [0, 1]),
        *jobs("removed", "chirp", ["cogging"], [0, 1]),
        *jobs("pairs", "chirp", two, [0, 1]),
    ]
    assert len({job.key for job in made}) == len(made) == 16
    assert made[8].key == "none chirp none seed 0" and [
        job.without for job in made[9:12]
    ] == [(), ("cogging",), ("cogging",)]
    assert made[-1].hidden == ("cogging", "backlash")


@pytest.mark.slow
def test_the_same_job_gives_the_same_row_but_for_the_time_it_took():
    job = Job(
        study="single",
        hidden=("coulomb_friction",),
        seed=3,
        design="chirp",
        strength=12.0,
    )
    rows = [run(job), run(job)]
    for one in rows:
        assert one.pop("cpu_s") > 0 and one.pop("recording_cpu_s") > 0
    assert rows[0] == rows[1]
    assert rows[0]["key"] == job.key and rows[0]["left_floors"] == pytest.approx(
        12.0, rel=0.2
    )
    assert (
        material(rows[0])
        and exact_but_for_algebra(rows[0])
        and named(rows[0])
        and not silently_wrong(rows[0])
    )


# ---- sensors of cells ----

ROW = {
    "hidden": "taxel_creep",
    "seed": 1,
    "found": ["taxel_creep"],
    "named": True,
    "status": "at_floor",
}
ROW |= {"before": 9.0, "after": 1.0, "error": 0.02, "cpu_s": 2.0}


def test_exact_is_the_hidden_effect_alone_and_of_a_clean_sensor_nothing():
    assert cells.exact(ROW)
    assert not cells.exact(ROW | {"found": ["taxel_creep", "touch_lag"]})
    assert not cells.exact(ROW | {"found": []})
    assert cells.exact(ROW | {"hidden": "", "found": []})
    assert not cells.material(ROW | {"before": 1.4})


def test_the_table_has_a_line_an_effect_and_names_each_case_that_was_not_exact():
    wrong = ROW | {
        "seed": 2,
        "found": ["touch_lag"],
        "error": None,
        "status": "something_else",
    }
    lines = cells.counted([ROW, wrong, ROW | {"seed": 3, "before": 1.2, "found": []}])
    assert "| taxel_creep | 3 | 2 | 1 of 2 | 9.00 | 1.00 | 2.0% |" in lines
    assert "taxel_creep (seed 2): touch_lag, something_else" in lines[-1]
    assert "taxel_creep (seed 3): nothing, at_floor" in lines[-1]


def test_one_case_is_run():
    row = cells.run((3, ""))
    assert cells.exact(row) and row["status"] == "nothing_missing"
    assert row["after"] < 1.3


# ---- figures hold the counts that they were given ----

ORIGIN = Origin("surrogate", "a test")


def test_confusion_matrix_holds_the_counts():
    counts = {
        "a": {"a": 18, "b": 1, "something else": 1},
        "b": {"b": 20},
        "none": {"nothing": 20},
    }
    figure = confusion_matrix(counts, [ORIGIN], "who is taken for whom")
    axes = figure.axes[0]
    labels = [t.get_text() for t in axes.get_xticklabels()]
    rows = [t.get_text() for t in axes.get_yticklabels()]
    found = {
        (
            rows[round(t.get_position()[1])],
            labels[round(t.get_position()[0])],
        ): t.get_text()
        for t in axes.texts
    }
    assert found == {
        ("a (n = 20)", "a"): "18",
        ("a (n = 20)", "b"): "1",
        ("a (n = 20)", "something else"): "1",
        ("b (n = 20)", "b"): "20",
        ("none (n = 20)", "nothing"): "20",
    }


def test_half_detection_is_where_misses_turn_into_finds():
    signals = np.geomspace(0.25, 4.0, 41)
    half, low, high = half_detected(signals, signals > 1.0)
    assert half == pytest.approx(1.0, rel=0.1)
    assert 0.7 < low < half < high < 1.4
    # drawn from the curve itself: the true 2 lies within the interval
    rng = np.random.default_rng(0)
    signals = np.exp(rng.uniform(np.log(0.3), np.log(10), 200))
    half, low, high = half_detected(
        signals, rng.random(200) < 1 / (1 + (2.0 / signals) ** SLOPE)
    )
    assert low < 2.0 < high < 1.3 * low
    assert (
        half_detected(np.array([3.0, 5.0]), np.array([True, True]))[1] == 0.0
    )  # never missed
    assert (
        half_detected(np.array([0.1, 0.2]), np.array([False, False]))[2] == np.inf
    )  # never found


def test_detection_curves_count_seeds_bin_by_bin():
    points = {
        "backlash": (
            np.array([4.0] * 10 + [1.0] * 10),
            np.array([True] * 10 + [True, False] * 5),
        )
    }
    figure = detection_curves(points, [ORIGIN], "detection", (0.5, 2.0, 8.0))
    axes = figure.axes[0]
    assert axes.get_title() == "backlash (n = 20)"
    dots = [
        float(mark.get_ydata()[0]) for mark in axes.lines if mark.get_marker() == "o"
    ]
    assert dots == [0.5, 1.0]
    bars = [list(mark.get_ydata()) for mark in axes.lines if mark.get_alpha() == 0.6]
    # Wilson, 10 of 10 at z = 1.96: low = 1 / (1 + z² / n) = 0.7225; 5 of 10: 0.5 ± 0.2634
    np.testing.assert_allclose(bars, [[0.2366, 0.7634], [0.7225, 1.0]], atol=1e-3)
