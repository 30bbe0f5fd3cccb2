"""The report of a run: yields with Wilson's intervals, boxes of the reset space, sources, failures; reckoned by hand."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from taccorl.episodes.sources.mimicgen.augment import AugmentPlan
from taccorl.episodes.sources.mimicgen.coverage import Attempt, Share, Spent, bins_of, numbers
from taccorl.episodes.sources.mimicgen.spec import load_mimic_spec
from taccorl.errors import TaccorlError
from taccorl.report.augmented import augmented, coverage_figure, pages_of
from taccorl.report.page import html
from taccorl.sim.randomize import draw
from taccorl.sim.task import tasks
from taccorl.tasks.experts import tasks_with_expert


def plan(task="assembly_2", **changes):
    return AugmentPlan(spec=load_mimic_spec(task), **changes)


def attempts_of(task, num, failed=(), unseen=(), **drawn):
    """Attempts with draws of the paper's ranges, but for what is given."""
    rng = np.random.default_rng(0)
    return [
        Attempt(
            k=k,
            outcome="dropped" if k in failed else "success",
            reason="it <fell>" if k in failed else "",
            scene_seed=100 + k,
            sources=frozenset({f"demo {k % 2}"}),
            draw=draw(tasks.get(task).rows, rng) | {name: np.array(values[k]) for name, values in drawn.items()},
            rows=0 if k in unseen else 300,
            process_s=2.0 if k in failed else 3.0,
            folder=Path(f"/a store/mimicgen/{k:016x}"),
        )
        for k in range(num)
    ]


def test_the_interval_is_wilsons():
    z, n, p = 1.959964, 10, 0.8
    middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * math.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    assert Share(successes=8, attempts=10).interval == pytest.approx((middle - half, middle + half), abs=1e-6)
    assert Share(successes=0, attempts=0).interval == (0.0, 1.0)
    assert str(Share(successes=8, attempts=10)) == "8 of 10: 80 % (95 %: 49 … 94)"


def test_boxes_cover_the_papers_range_and_each_attempt_lies_in_one():
    # Friction 0.3 … 0.7 in four boxes of 0.1; the plug's ± 30 mm in boxes of 20 mm.
    frictions, places = [[0.31], [0.45], [0.69], [0.7]], [[-0.02, -0.02], [0.0, 0.0], [0.005, 0.0], [0.03, -0.03]]
    attempts = attempts_of("assembly_2", 4, failed={2}, friction=frictions, plug_position=places)
    boxes = list(bins_of(plan(), attempts))
    friction = [b for b in boxes if b["row"] == "friction"]
    assert [b["low"][0] for b in friction] == pytest.approx([0.3, 0.4, 0.5, 0.6])
    assert [(b["share"]["successes"], b["share"]["attempts"]) for b in friction] == [(1, 1), (1, 1), (0, 0), (1, 2)]
    plug = {tuple(np.round(b["low"], 3)): b["share"] for b in boxes if b["row"] == "plug_position"}
    assert len(plug) == 9
    assert plug[-0.03, -0.03] == Share(successes=1, attempts=1).record()
    assert plug[-0.01, -0.01] == Share(successes=1, attempts=2).record()
    assert plug[0.01, -0.03] == Share(successes=1, attempts=1).record()
    for row in tasks.get("assembly_2").rows:
        assert sum(b["share"]["attempts"] for b in boxes if b["row"] == row.name) == 4


def test_sources_failures_and_cost_are_counted():
    told = numbers(plan(), attempts_of("assembly_2", 6, failed={0, 2}, unseen={0}), Spent(24.0, 90.0))
    assert told["yield"]["successes"] == 4
    shares = {s["source"]: (s["successes"], s["attempts"], s["share_of_successes"]) for s in told["sources"]}
    assert shares == {"demo 0": (1, 3, 0.25), "demo 1": (3, 3, 0.75)}
    assert told["failures"] == {"dropped": 2}
    assert told["failed"][0]["command"] is None
    assert told["failed"][1]["command"] == "taccorl view '/a store/mimicgen/0000000000000002'"
    assert told["cost"]["process_s_per_success"] == pytest.approx((4 * 3.0 + 2 * 2.0) / 4)
    assert told["cost"]["cpu_s_per_success"] == pytest.approx(6.0)
    assert told["cost"]["wall_s"] == 90.0
    json.dumps(told)


def test_the_page_names_poor_boxes_and_every_failure_and_needs_no_other_file():
    # All 20 that began at little friction failed, the 60 others succeeded: yield 75 %, of that box 0 … 16 %.
    frictions = [[0.35 if k < 20 else 0.65] for k in range(80)]
    attempts = attempts_of("assembly_2", 80, failed=set(range(20)), friction=frictions)
    told = numbers(plan(), attempts, None) | {"source": "old", "dataset": "new"}
    told |= {"grips": {"hands": [{"arm": "left", "part": "<b>", "sources": 3, "different": 2}], "few": True}}
    page = html("", augmented(plan(), told), "")
    assert '<td>friction</td><td>0.3 … 0.4</td><td class="n">0 of 20: 0 % (95 %: 0 … 16)</td>' in page
    assert page.count("taccorl view ") == 20
    assert "it &lt;fell&gt;" in page
    assert "twin: MuJoCo twin, not a robot" in page
    assert "What the whole run took is not known" in page
    for name in ("retarget", "contact_mode"):
        assert f"<tr><td>{name}</td><td>{getattr(plan().spec.datagen_config, name)}</td></tr>" in page
    assert not [part for part in ("http:", "https:", "<script", "<link") if part in page]


@pytest.mark.parametrize("task", tasks_with_expert())
def test_coverage_has_a_panel_for_each_row_of_every_task(task):
    told = numbers(plan(task), attempts_of(task, 12, failed={3}), None)
    figure = coverage_figure(plan(task), told)
    shown = [ax.get_title() for ax in figure.axes if ax.get_visible()]
    assert shown == [row.name.replace("_", " ") for row in tasks.get(task).rows]
    for ax, row in zip(figure.axes, tasks.get(task).rows, strict=False):
        drawn = sum(len(c.get_offsets()) for c in ax.collections if c.get_offsets().size and "Path" in type(c).__name__)
        assert drawn == 12, row.name


def test_a_page_that_is_not_ours_is_left_alone(tmp_path):
    (tmp_path / "new.augment_report.json").write_text("{}")
    with pytest.raises(TaccorlError, match=r"new\.augment_report\.json: already exists.*report"):
        pages_of(tmp_path / "new")
