"""One page that needs no other file and says what it was made from; its numbers are those of the comparison."""

import dataclasses
import json
import re
import shutil
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from made_traces import ORIGIN, comparison, swing, touch_trace, trace
from simulated_sweeps import SIGNAL, friction, sweeps

import taccorl
from taccorl.data.finding import Finding
from taccorl.data.origin import Origin
from taccorl.diagnosis.comparison.compare import compare
from taccorl.diagnosis.machines.piper import PiperTwin
from taccorl.diagnosis.problems.joints import JointFinding, diagnose_joint
from taccorl.diagnosis.search.result import SearchConfig
from taccorl.errors import SpecError, TaccorlError, plain_name
from taccorl.report.account import account
from taccorl.report.compared import pad_matches
from taccorl.report.diagnosed import account_section
from taccorl.report.evidence import Seen, separable
from taccorl.report.fact import clean, fact
from taccorl.report.ingested import ingested
from taccorl.report.page import html
from taccorl.report.report import (
    NUMBERS,
    PAGE,
    Report,
    as_json,
    check_folder,
    write_report,
)
from taccorl.report.section import Cell, Picture, Section, cell, change
from taccorl.report.terminal import show
from taccorl.sim.effects import effects
from taccorl.sim.twin import TwinConfig

_, POSITION = swing(seconds=6.0)


def small(**fields) -> Report:
    before = comparison(trace(5e-3 * np.sign(POSITION), POSITION))
    return Report(
        **{"title": "made twin beside made traces", "comparison": before} | fields
    )


class Tags(HTMLParser):
    """Addresses and unclosed elements of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.open: list[str] = []
        self.text = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [
            value or "" for name, value in attrs if name in ("src", "href")
        ]
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report without a diagnosis; tests change copies only."""
    folder = tmp_path_factory.mktemp("report")
    said = write_report(small(provenance={"command": "taccorl compare sweeps"}), folder)
    assert list(said.text) == [f"wrote {folder / PAGE} and {NUMBERS}"]
    return folder / PAGE


def test_page_needs_no_other_file_and_says_where_its_data_is_from(written: Path):
    page = written.read_text()
    tags = Tags(page)
    assert tags.open == [], "every element is closed"
    assert tags.addresses and all(
        a.startswith("data:image/png;base64,") for a in tags.addresses
    )
    assert (
        not re.search(r"https?://|<script|@import|url\(", page)
        and f"data: {ORIGIN}" in tags.text
    )
    assert (
        "where the twin is off, not why" in tags.text
        and "taccorl compare sweeps" in tags.text
    )


def test_the_paper_s_five_numbers_of_pads_stand_before_and_after(tmp_path: Path):
    # Pad a of 2 × 3 taxels, active above 4 floors of 1 count: measured {00, 01}; the twin
    # has {01} in all frames, the mended twin what was measured. Pad b reads nothing.
    measured = np.zeros((200, 2, 2, 3))
    measured[:, 0, 0] = [10.0, 30.0, 4.0]
    replayed = measured.copy()
    replayed[:, 0, 0] = [0.0, 40.0, 0.0]
    before, after = (
        comparison(touches=(touch_trace(measured, counts, 1.0, pitch_m=2e-3),), twin=n)
        for n, counts in (("twin", replayed), ("mended twin", measured))
    )
    report = Report(title="pads", comparison=before, after=after)
    found = as_json(report)
    one, silent = found["touch_match"]
    mended, _ = found["touch_match_after"]
    assert (one["pad"], one["use"], one["frames"]) == ("left_a", "validation", 200)
    assert one["mask_iou"] == pytest.approx(1 / 2)
    assert one["active_taxels"] == pytest.approx(1.0)
    # Column (10·0 + 30·1) / 40 = 0.75 against 1, of 2 mm
    assert one["centroid_m"] == pytest.approx(0.25 * 2e-3)
    # Half of 10, 30 moves from 10 to 40, the other half from 30 to 40.
    assert one["histogram_count"] == pytest.approx((30 + 10) / 2)
    assert one["temporal_count"] == 0.0
    assert (mended["mask_iou"], mended["centroid_m"]) == (1.0, 0.0)
    assert silent["pad"] == "left_b" and silent["centroid_m"] is None
    assert "no frame" in silent["undefined"]["centroid_m"]
    (section,) = pad_matches(before, after)
    table, other = section.parts
    assert list(table.heads) == ["number", "twin", "mended twin", "unit"]
    assert list(table.rows[2]) == ["centroids", "0.5", "0", "mm"]
    assert list(other.rows[2]) == ["centroids", "undefined", "undefined", "mm"]


def test_numbers_are_those_of_the_comparison(tmp_path: Path):
    report = small(
        after=comparison(trace(2e-4 * np.sign(POSITION), POSITION), twin="mended twin")
    )
    write_report(report, tmp_path)
    found = json.loads((tmp_path / NUMBERS).read_text())
    score = report.comparison.scores()[0]
    assert (
        found["scores"][0]["rmse"] == score.rmse
        and found["scores"][0]["ratio"] == score.ratio
    )
    assert found["scores_after"][0]["ratio"] == pytest.approx(1.0, rel=1e-3) and found[
        "data"
    ] == [str(ORIGIN)]
    assert {c["regime"] for c in found["where"]["cells"]} >= {
        "after a reversal",
        "high speed",
    }
    text = Tags((tmp_path / PAGE).read_text()).text
    assert "5 mrad" in text and "-96%" in text and "mended twin" in text


def test_errors_hold_up_the_joints_of_their_own_recordings_only():
    both = comparison(
        trace(0 * POSITION, POSITION, recording="a.csv", signal="left_joint5"),
        trace(0 * POSITION, POSITION, recording="b.csv", signal="left_joint4"),
        clock={
            "b.csv": (Finding("shifted_from_twin", "error", "left_joint4", "leads"),)
        },
    )
    report = small(
        comparison=both,
        findings={
            "a.csv": [],
            "b.csv": [Finding("unit", "error", "left_joint4", "degrees")],
        },
    )
    assert report.unsettled("left_joint5") == []
    assert report.unsettled("left_joint4") == ["b.csv: degrees", "b.csv: leads"]
    assert report.unsettled("left pads") == report.unsettled("left_joint4"), (
        "a part without traces sees all"
    )


def test_an_earlier_report_is_replaced_and_told_and_another_file_is_left_alone(
    written: Path, tmp_path: Path
):
    shutil.copytree(written.parent, tmp_path, dirs_exist_ok=True)
    page = tmp_path / PAGE
    (said,) = write_report(small(title="the second"), tmp_path).text
    assert (
        re.search(r"replaced .* \d{4}-\d\d-\d\d \d\d:\d\d", cell(said).text)
        and "the second" in page.read_text()
    )
    assert sorted(p.name for p in tmp_path.iterdir()) == [PAGE, NUMBERS]
    (tmp_path / NUMBERS).write_text('{"mine": 1}')
    with pytest.raises(TaccorlError, match="not a report of taccorl"):
        write_report(small(title="the third"), tmp_path)
    assert "the second" in page.read_text()
    with pytest.raises(TaccorlError, match="is a file"):
        check_folder(page)


def test_names_from_files_are_text_and_no_html(tmp_path: Path):
    """Of recordings, signals, regimes, twins and checks; and no page runs a script or loads anything."""
    name = "<script>alert(1)</script>&.csv"
    signal = "<img src=x onerror=alert(1)>"
    own = dataclasses.replace(
        trace(
            1e-3 * POSITION,
            POSITION,
            recording=name,
            origin=Origin(text="<b>robot</b>"),
        ),
        signal=signal,
    )
    bad = comparison(own, left_out=(f"touch of {name}",), twin="<i>twin</i>")
    report = small(
        comparison=bad,
        after=bad,
        findings={name: [Finding("jitter", "warning", signal, "steps < 5 ms & more")]},
        provenance={"<u>command": "<u>compare"},
    )
    write_report(report, tmp_path)
    text = (tmp_path / PAGE).read_text()
    tags = Tags(text)
    assert (
        "script" not in tags.open
        and "<img src=x" not in text
        and "<i>twin" not in text
        and "<u>" not in text
    )
    for words in (
        name,
        signal,
        "<b>robot</b>",
        "<i>twin</i>",
        "steps < 5 ms & more",
        "<u>compare",
    ):
        assert words in tags.text
    (policy,) = re.findall(
        r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">', text
    )
    assert "default-src 'none'" in policy and "script-src" not in policy


@pytest.fixture(scope="module")
def diagnosed(tmp_path_factory: pytest.TempPathFactory) -> tuple[JointFinding, Path]:
    """The report on dry friction hidden in simulated sweeps."""
    measured = sweeps(friction(), seconds=4.0)
    # Two of each family: forms of friction that tie, and effects that explain next to nothing.
    few = ["coulomb_friction", "asymmetric_friction", "position_dependent_friction"]
    few += ["backlash", "sensor_delay", "cogging"]
    without = [name for name in effects if name not in few]
    finding = diagnose_joint(
        TwinConfig(), SIGNAL, measured, search=SearchConfig(width=1), without=without
    )
    report = Report(
        title="what is missing",
        comparison=compare(TwinConfig(), measured, name="nominal twin"),
        refitted=PiperTwin.nominal()
        .refitted([finding])
        .compare(measured, name="refitted twin"),
        after=PiperTwin.nominal()
        .mended([finding])[0]
        .compare(measured, name="mended twin"),
        found=[finding],
        options=["--twin=a.yaml"],
    )
    folder = tmp_path_factory.mktemp("diagnosed")
    write_report(report, folder)
    return finding, folder / PAGE


def facts(finding: JointFinding) -> list[str]:
    """Names, texts and numbers of a finding that its part of the page has."""
    d, known = finding.diagnosis, finding.known
    (effect,), cls = d.effects, effects.get("coulomb_friction")
    found = [SIGNAL, effect.name, d.words, finding.noise, finding.numbers]
    found += [finding.measured, *finding.recordings["validation"], *known.pinned_by]
    gone = d.errors["after"]["validation"] / d.errors["fitted"]["validation"] - 1
    found += [f"{gone:+.0%}", cls.equation, cls.in_words, cls.at_a_policy]
    found += [cls.to_record, *cls.near_twins, *cls.near_twins.values()]
    for stage in ("before", "fitted"):
        found += [f"{x:.2f}" for use, x in d.errors[stage].items() if use != "fit"]
    for n in known.identifiable:
        ends = [clean(x, n.high - n.low) for x in (n.value, n.low, n.high)]
        found += [n.name, ends[0], " … ".join(ends[1:])]
    for e in d.rounds[0].evidence:
        found += [e.name, f"{e.score:.1f}", e.verdict, effects.get(e.name).equation]
    return found


def test_each_fact_of_a_diagnosis_is_on_the_page_in_the_terminal_and_in_json(
    diagnosed, capsys
):
    finding, path = diagnosed
    report = json.loads((path.parent / NUMBERS).read_text())
    own = report["verdicts"][SIGNAL]
    d = finding.diagnosis
    a = account(SIGNAL, d, Seen(has_effort=True))
    show(account_section(a))
    page, terminal = (
        " ".join(text.split())
        for text in (Tags(path.read_text()).text, capsys.readouterr().out)
    )
    for text in facts(finding):
        assert " ".join(text.split()) in page, text
    for f in a.facts[1:]:
        assert f.text in terminal and f.text in page, f.id
    assert {f["id"] for f in own["facts"]} >= {*a.ids} - {"plan", "record_repeat"}
    assert (own["kind"], own["title"]) == (a.kind, a.title)
    (missing,) = (f for f in own["facts"] if f["id"] == "missing")
    assert missing["values"]["effect"] == d.names[0] and missing["text"] in page
    apart = separable(d, d.names[0], d.rivals.get(d.names[0], ()))
    assert page.count("--twin=a.yaml") == bool(apart), "excite"


def test_a_number_of_json_has_its_unit_and_its_interval(diagnosed):
    """The file of a diagnosis without an effect has the number that moved as an object."""
    finding, _ = diagnosed
    d = finding.diagnosis
    kp = dataclasses.replace(d.before.frees[0], name="kp", unit="N·m/rad", high=1e3)
    after = dataclasses.replace(d.after, frees=(kp,), jacobian=d.after.jacobian[:, :1])
    off = dataclasses.replace(
        d,
        effects=(),
        status="nothing_missing",
        base={"kp": 241.0},
        start={"kp": 394.0},
        intervals={"kp": (240.0, 242.0)},
        after=after,
        errors=d.errors | {"before": {"fit": 9.0, "validation": 99.0, "test": 99.0}},
    )
    report = small(found=[dataclasses.replace(finding, diagnosis=off)])
    own = as_json(report)["verdicts"][SIGNAL]
    (kp,) = (f for f in own["facts"] if f["id"] == "changed")
    assert own["kind"] == "numbers_off" and kp["values"]["before"] == 394.0
    after = {"value": 241.0, "unit": "N·m/rad", "low": 240.0, "high": 242.0}
    assert kp["values"]["after"] == after
    assert as_json(report)["diagnoses"][SIGNAL]["moved"] == ["kp"]


def test_the_next_command_stands_once_for_one_part_and_for_several(diagnosed):
    finding, _ = diagnosed
    step = (fact("next", command="taccorl add-effect x"),)
    other = dataclasses.replace(finding, part="left_joint6")
    for found in ([finding], [finding, other]):
        report = small(found=found, next=step)
        text = html("x", report.sections(), "x")
        assert text.count("taccorl add-effect x") == 1
        own = [a.ids.count("next") for a in report.accounts().values()]
        assert own == ([1] if len(found) == 1 else [0, 0])


def test_a_lead_that_only_one_effect_of_several_left_behind_holds_nothing_up(
    diagnosed: tuple[JointFinding, Path],
):
    """A second missing effect can look like an offset; the search may go on. One that was there from the beginning stays."""
    leads = {"b.csv": (Finding("shifted_from_twin", "error", SIGNAL, "leads"),)}
    before, after = (
        comparison(trace(0 * POSITION, POSITION, recording="b.csv", signal=SIGNAL))
        for _ in range(2)
    )
    stopped = dataclasses.replace(diagnosed[0].diagnosis, status="too_many")
    for d, clock, told in (
        (stopped, {}, []),
        (diagnosed[0].diagnosis, {}, ["b.csv: leads"]),
        (stopped, leads, ["b.csv: leads"]),
    ):
        report = small(
            comparison=dataclasses.replace(before, clock=clock),
            after=dataclasses.replace(after, clock=leads),
            found=[dataclasses.replace(diagnosed[0], diagnosis=d)],
        )
        assert report.unsettled(SIGNAL) == told


def test_a_number_that_is_nothing_beside_its_interval_is_zero_and_no_change_has_no_sign():
    assert (clean(2.6e-13, 4e-5), clean(-0.0285, 0.001), clean(0.01200032, 6e-7)) == (
        "0",
        "-0.0285",
        "0.01200032",
    )
    assert (change(100.0, 99.7), change(2.0, 1.0)) == ("+0%", "-50%")


def test_heat_maps_are_of_the_twin_whose_gains_are_refitted(
    diagnosed: tuple[JointFinding, Path],
):
    """The first row of a score is the twin as given; the map must not credit an effect with what gains removed."""
    finding, path = diagnosed
    found = json.loads((path.parent / NUMBERS).read_text())
    assert found["where"]["twin"] == "refitted twin"
    given, refitted_, after = (
        next(
            s["ratio"]
            for s in found[k]
            if s["kind"] == "position" and s["use"] == "fit"
        )
        for k in ("scores", "scores_refitted", "scores_after")
    )
    cells = [c for c in found["where"]["cells"] if c["kind"] == "position"]
    thirds = [
        c
        for c in cells
        if c["regime"]
        in tuple(f"{k} third of the time" for k in ("first", "second", "last"))
    ]
    over_all = np.sqrt(
        sum(c["ratio"] ** 2 * c["n"] for c in thirds) / sum(c["n"] for c in thirds)
    )
    assert over_all == pytest.approx(refitted_, rel=0.3)
    assert given > refitted_ > 2 * after, "gains took some of it, the effect the rest"
    assert finding.diagnosis.steps[0][0] == "" and len(finding.diagnosis.steps) == 2


def test_numbers_hold_the_diagnosis_and_first_those_that_are_identified(
    diagnosed: tuple[JointFinding, Path],
):
    """Recorded efforts determine the scale of the torques, so that the friction of 1 N·m is identified and not only its ratio
    to K_p. No residuals are among the numbers."""
    finding, path = diagnosed
    content = (path.parent / NUMBERS).read_text()
    every = json.loads(content)
    own, found, d = (
        every["diagnoses"][SIGNAL],
        every["identified"][SIGNAL],
        finding.diagnosis,
    )
    assert (own["effects"][0]["effect"], own["status"], own["errors"]) == (
        "coulomb_friction",
        d.status,
        d.errors,
    )
    assert (
        own["effects"][0]["torque_nm"] == vars(d.effects[0])["torque_nm"]
        and len(content) < 200_000
    )
    assert found["pinned_by"] == list(finding.known.pinned_by) == ["recorded effort"]
    numbers = {n["name"]: n for n in found["identifiable"]}
    assert (
        numbers["kd/kp"]["unit"] == "s"
        and numbers["coulomb_friction.torque_nm/kp"]["unit"] == "rad"
    )
    assert numbers["coulomb_friction.torque_nm"]["value"] == pytest.approx(
        1.0, rel=0.03
    )
    page = Tags(path.read_text()).text
    assert page.index("coulomb_friction.torque_nm/kp") < page.index(
        "number of the twin"
    )
    assert (
        "identified: coulomb_friction.torque_nm/kp"
        in finding.diagnosis.effects[0].evidence
    )


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.skipif(
    not (shutil.which("chromium") and find_spec("playwright")),
    reason="no browser to look with: apt-get install chromium, pip install playwright",
)
def test_a_browser_shows_every_picture_and_asks_nobody(
    diagnosed: tuple[JointFinding, Path], tmp_path: Path
):
    from playwright.sync_api import sync_playwright

    asked: list[str] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.on("request", lambda request: asked.append(request.url))
        page.goto(diagnosed[1].as_uri())
        sizes = page.evaluate(
            "[...document.images].map(i => [i.naturalWidth, i.complete])"
        )
        wide = page.evaluate("document.documentElement.scrollWidth")
        browser.close()
    assert len(sizes) >= 6 and all(
        width > 300 and complete for width, complete in sizes
    )
    assert [a for a in asked if not a.startswith("data:")] == [diagnosed[1].as_uri()]
    assert wide <= 1280, "nothing sticks out of the window"


# ---- what enters a section is text, wherever it stands ----

BAD = """<img src=x onerror="alert('1')">&amp;"""
SHOWN = "&lt;img src=x onerror=&#34;alert(&#39;1&#39;)&#34;&gt;&amp;amp;"
PNG = b"\x89PNG"


@pytest.mark.parametrize(
    "section",
    [
        Section(title=BAD),
        Section(title=BAD, folded=True),
        Section(text=[BAD]),
        Section(text=[BAD], style="low"),
        Section(heads=(BAD,), rows=[("1",)]),
        Section(rows=[(BAD,)]),
        Section(rows=[("1",)], marks=(BAD,)),
        Section(notes=[BAD]),
        Section(command=BAD),
        Section(figures=[Picture(lambda: PNG, BAD)]),
        Section(parts=[Section(text=[BAD])]),
        *(
            Section(rows=[(Cell(BAD, style),)])
            for style in ("", "bad", "bold", "code", "link")
        ),
        Section(rows=[(Cell("x", hint=BAD),)]),
        Section(rows=[(Cell("x", more=[BAD]),)]),
    ],
)
def test_text_is_escaped_wherever_it_enters(section: Section):
    page = html(BAD, [section], BAD)
    assert "<img src=x" not in page and page.count(SHOWN) >= 4, (
        "title, heading, generator and the section"
    )
    assert "default-src 'none'" in page and "<script" not in page


def test_a_section_of_one_place_is_in_that_place_only(
    capsys: pytest.CaptureFixture[str],
):
    both = [Section(text=["p"], only="page"), Section(text=["b"])]
    show(*both, Section(title="outer", parts=both))
    assert capsys.readouterr().out.split() == ["b", "outer", "b"]
    page = html("x", [*both, Section(title="outer", parts=both)], "x")
    assert [page.count(f"<div>{word}</div>") for word in "pb"] == [2, 2]


def test_paths_and_reasons_are_shown_whole_in_a_narrow_terminal(monkeypatch, capsys):
    monkeypatch.setattr("taccorl.report.terminal.WIDE", 60)
    path = "/data/robots/left_lab/2026-11-22/very_long_session_name/demonstration_000123.mcap"
    reason = f"{path}: /front/camera/image_raw/compressed: a message at log time 1700000000000000000 ns does not fit"
    entry = {
        "recording": path,
        "part": None,
        "outcome": "refused",
        "reason": reason,
        "command": f"taccorl check {path}",
    }
    show(
        ingested(
            {"recordings": [{**entry, "episodes": []}], "outcomes": {"refused": 1}}
        )
    )
    shown = capsys.readouterr().out
    assert f"refused {reason}\n" in shown and f"taccorl check {path}\n" in shown
    assert "…" not in shown
    table = shown.split("refused /data")[0]
    assert path in "".join(
        line.split("  ")[0].strip() for line in table.splitlines()[1:]
    )  # folded, not cut


def test_no_other_module_writes_html():
    """Every page goes through the template, and no f-string holds a tag."""
    root = Path(taccorl.__file__).parent
    for path in root.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        assert not re.search(
            r"<!doctype|import html$|html\.escape|Markup", text, re.MULTILINE
        ), path
        assert not re.search(
            r"f[\"']<(p|h1|h2|h3|td|tr|li|ul|div|b|span|code|details)[ >]", text
        ), path


@pytest.mark.parametrize(
    "name",
    [
        "a<b",
        "a>b",
        "a&b",
        "a\x1b[31m",
        "a\nb",
        "a\u202eb",
        "\x9b2J",
        "a\u2028b",
        "\x00",
    ],
)
def test_names_that_steer_a_terminal_or_a_page_are_refused_with_their_place(name: str):
    with pytest.raises(SpecError, match=r"arm\.urdf:3: .*character"):
        plain_name(name, "arm.urdf:3: <joint>")
    assert plain_name("left/joint 1-µ:2'é", "x") == "left/joint 1-µ:2'é"
