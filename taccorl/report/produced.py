"""What a run that produced episodes has made: one section for collect, augment, correct and execute."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from taccorl.report.section import Section


def section(out: Path, report: Mapping[str, Any], lines: Sequence[str], seconds: Mapping[str, float]) -> Section:
    """The section of a run.

    Args:
        report: content of its collect_report.json.
        lines: what its verb says of its own.
        seconds: part of the work → mean time of an episode [s].
    """
    made = f"({report['episodes']} episodes, {report['rows']} rows): {report['domain']}: {report['origin']}"
    outcomes = {outcome: num for outcome, num in report.get("outcomes", {}).items() if outcome != "success"}
    failed = ", ".join(f"{num} {outcome}" for outcome, num in (outcomes | report.get("dropped", {})).items())
    took = ", ".join(f"{part} {s:.2f} s" for part, s in seconds.items())
    own = [f"failed:  {failed}"] * bool(failed) + [f"took:    {took} for each episode"] * bool(took)
    return Section(text=[f"dataset: {out}  {made}", *lines, *own])
