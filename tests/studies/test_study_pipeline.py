"""The study's machinery: cases that fail, rows that are there already, the page from rows written by hand."""

import json
from typing import Any

from pipelines import diagnosis_page, diagnosis_study
from pipelines.studies.joints_and_pads import Job, failed, jobs
from taccorl.lineage.processes import Done, Failed


def test_pads_come_first_and_reference_loops_are_among_the_cases():
    made = [
        *jobs("single", "chirp", ["cogging"], range(60)),
        *jobs("single", "press", ["touch_lag"], range(30)),
    ]
    order = diagnosis_study.ordered(made, "now")
    assert [j.design for j in order if isinstance(j, Job)] == ["press"] * 30 + [
        "chirp"
    ] * 60
    assert [k for k, j in enumerate(order) if isinstance(j, str)] == [0, 41, 82]


def test_final_seeds_are_none_that_anything_was_tuned_on():
    for name, jobs_of in diagnosis_study.STUDIES.items():
        seeds = {j.seed for j in jobs_of(diagnosis_study.FIRST_SEED, 10)}
        assert min(seeds) >= 60000, name
    assert (
        len(diagnosis_study.STUDIES["none"](0, 10)) >= 150
        and len(diagnosis_study.STUDIES["outside"](0, 10)) >= 60
    )


def test_of_a_case_that_was_run_again_the_last_row_counts(tmp_path, monkeypatch):
    rows = tmp_path / "rows.jsonl"
    first = failed(
        Job(study="single", hidden=("cogging",), seed=1, design="chirp"),
        "its process died",
    )
    rows.write_text(
        json.dumps(first)
        + "\n"
        + json.dumps({"key": first["key"], "study": "single"})
        + "\n"
    )
    assert diagnosis_study.read_rows(rows) == [{"key": first["key"], "study": "single"}]
    assert diagnosis_study.read_rows(tmp_path / "none.jsonl") == []


def test_a_run_skips_what_is_there_and_stores_what_fails(tmp_path, monkeypatch, capsys):
    path = tmp_path / "rows.jsonl"
    made = jobs("single", "chirp", ["cogging", "backlash", "slew_limit"], [300])
    path.write_text(json.dumps(row(made[0])) + "\n")

    def ran(work, these, workers, name, take, care, first):
        for k, job in enumerate(these):
            if not isinstance(job, str) and job.study != "warm-up":
                good = job.hidden == ("backlash",)
                take(
                    k,
                    Done(row(job))
                    if good
                    else Failed("ValueError: no", "Traceback\nValueError: no"),
                )

    monkeypatch.setattr(diagnosis_study, "run_in_processes", ran)
    monkeypatch.setitem(diagnosis_study.STUDIES, "chirp", lambda first, n: made)
    diagnosis_study.main(["chirp", f"--rows={path}"])
    rows = {r["key"]: r for r in diagnosis_study.read_rows(path)}
    assert [r for r in rows if r.startswith("single")] == [j.key for j in made]
    assert rows[made[2].key]["failed"] == "Traceback\nValueError: no"
    assert "2 rows more, 1 of them of cases that failed" in capsys.readouterr().out


def row(job: Job, **other: Any) -> dict[str, Any]:
    name = job.hidden[0] if job.hidden else ""
    return {
        "key": job.key,
        "study": job.study,
        "hidden": list(job.hidden),
        "seed": job.seed,
        "design": job.design,
        "strength": None,
        "without": [],
        "status": "at_floor" if name else "nothing_missing",
        "found": list(job.hidden),
        "first": name or None,
        "ties": {},
        "swapped": [],
        "rivals": {},
        "errors": {
            "fitted": {"validation": 5.0 if name else 1.0},
            "after": {"fit": 1.0, "validation": 1.05, "test": 1.0},
        },
        "conditions": ["effort"],
        "findings": [],
        "numbers": {
            "kd/kp": [0.1, 0.09, 0.11, 0.105],
            f"{name or 'x'}.a/kp": [1.0, 0.9, 1.1, 1.2],
        },
        "cpu_s": 5.0,
    } | other


def test_the_page_counts_failed_cases_as_wrong_and_shows_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "docs").mkdir()
    made = jobs("single", "chirp", ["cogging"], range(20000, 20004))
    rows = [row(j) for j in made[:3]] + [
        failed(made[3], "Traceback\nValueError: no robot")
    ]
    rows.append(
        {"key": "m", "study": "machine", "machine": "EPYC, 16 cores", "workers": 16}
    )
    rows += [
        {"key": f"reference {k}", "study": "reference", "cpu_s": s}
        for k, s in enumerate((2.0, 2.4, 3.0))
    ]
    page = tmp_path / "docs" / "diagnosis.md"
    marks = (diagnosis_page.STUDY, diagnosis_page.OTHERS)
    page.write_text(f"the story\n\n{marks[0]}\nold\n{marks[1]}\nothers\n")
    diagnosis_page.write_page(rows)
    text = page.read_text()
    assert text.startswith(f"the story\n\n{marks[0]}\n## How often")
    assert text.endswith(f"\n{marks[1]}\nothers\n") and "\nold\n" not in text
    assert (
        "| one hidden joint effect, pack and chirp: exact, counted as one | ≥ 87% | 75% (3 of 4;"
        in text
    )
    assert "- single chirp cogging seed 20003: ValueError: no robot" in text
    assert (
        "EPYC, 16 cores, 16 processes" in text
        and "2.40 CPU-s in the median of 3 runs (2.00 to 3.00)" in text
    )
    # kd/kp is inside, the hidden effect's own number is not, in three cases.
    assert "hold the truth, joints | ≥ 88% | 50% (3 of 6;" in text
    assert "| … numbers of the hidden effects only |  | 0% (0 of 3;" in text
    assert (
        "simulated" in text
        and (tmp_path / "docs" / "diagnosis_confusion_chirp.png").is_file()
    )
