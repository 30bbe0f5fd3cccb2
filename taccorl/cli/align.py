"""``taccorl align sweeps/ --twin=twin.yaml``: fit the numbers that the PiPER's twin has anyway to measurements (paper App. B).

Joints that move: K_d and T_ref, with --fit_kp=true also K_p; by least squares, or by the paper's SPSA (--method=spsa). Pads for
which measurements.yaml states the pressed object: k_n and k_d, with the paper's five numbers of the match. Cameras that
--cameras names: pose, latency and exposure, from the first episode. Each number has its 95 % interval; errors before and after
are those of validation recordings (cameras: of frames that were not fitted). Writes a new twin. Then ``taccorl diagnose``
searches for effects.
"""

import dataclasses
import itertools
import json
import math
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from taccorl.cli.measured import PartsConfig, replayed
from taccorl.cli.parse import parse
from taccorl.data.finding import Finding, listed
from taccorl.errors import TaccorlError, nearest
from taccorl.report.section import Cell, Section

if TYPE_CHECKING:
    from taccorl.alignment.measurements.folder import Measurements
    from taccorl.diagnosis.align import Alignment
    from taccorl.diagnosis.comparison.result import Comparison
    from taccorl.diagnosis.machines.piper import PiperTwin

TWIN, REPORT = "twin.yaml", "report.json"
"""Names of the files in the output folder."""
NO_JOINT = (
    "--method=spsa: searches for gains of joints, and none is to be aligned; name some by "
    "--joints=, or remove --method"
)
LATE_S = 0.01
"""Delay of a joint's measurement after the twin's replay [s] from which on its gains are not fitted: a tenth of K_d / K_p of the
PiPER's joints (0.084 … 0.12 s), by which fitted gains would be wrong."""
SAME = 1e-3
"""Share by which an error may rise and still counts as the same (a choice)."""
FAR_ABOVE_FLOOR = 2.0
"""Noise floors of error left on validation recordings from which on a missing effect is named as the reason."""


@dataclass(kw_only=True)
class AlignConfig(PartsConfig):
    """Fit the numbers that the PiPER's twin has anyway to measurements."""

    cameras: list[str] = field(default_factory=list)
    """These cameras: front, left_wrist, right_wrist, of one recording or dataset."""
    fit_kp: bool = False
    """Fit K_p of joints, too. Positions determine K_d / K_p and T_ref / K_p but hardly K_p itself; without this option K_p stays
    what the recordings state, or the twin's. SPSA fits K_p in any case, as in the paper, unless the recordings state it."""
    method: Literal["least_squares", "spsa"] = "least_squares"
    """Search for the gains of joints. spsa: the paper's, with its loss and constants, from the twin's gains; it ends near the
    minimum, where least_squares ends at it."""
    seed: int = 0
    """Seed of the random signs of --method=spsa, at least 0."""
    out: Path = Path("alignment")
    """Folder of twin.yaml, report.json and, of each camera, a picture of outlines before and after; it must be new or empty."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.seed < 0:
            raise TaccorlError(f"--seed={self.seed}: at least 0")
        if self.seed and self.method != "spsa":
            raise TaccorlError(
                f"--seed={self.seed}: only --method=spsa draws random signs; add that, "
                "or remove --seed"
            )
        if self.method == "spsa" and (self.pads or self.cameras) and not self.joints:
            raise TaccorlError(NO_JOINT)


def main(argv: list[str]) -> int:
    """Run ``taccorl align`` with the words ``argv`` after it; returns the exit status, 0: all parts were aligned, 1: some were
    not, or the measurements have errors."""
    config = parse(AlignConfig, argv, positional="measurements")
    from taccorl.lineage.destinations import check_writable, is_free

    if not is_free(config.out):
        held = "holds files already" if config.out.is_dir() else "is a file"
        raise TaccorlError(
            f"--out={config.out}: {held}; nothing was changed: give another folder"
        )
    config.check_paths()
    from taccorl.diagnosis.align import align_parts, aligned
    from taccorl.diagnosis.machines.load import load_machine
    from taccorl.diagnosis.machines.piper import PiperTwin
    from taccorl.diagnosis.problems.joints import SIGNALS
    from taccorl.report.report import plain
    from taccorl.report.terminal import show
    from taccorl.sim.twin_file import save_twin

    machine = load_machine(config.twin)
    if not isinstance(machine, PiperTwin):
        raise TaccorlError(
            f"{config.twin}: describes another machine than the PiPER; its numbers are fitted by taccorl diagnose "
            "--until=noise_floor, which writes them into a new file"
        )
    _check_cameras(config.cameras, machine, config.measurements, config.spec)
    check_writable(config.out)
    found: list[Alignment] = []
    if config.joints or config.pads or not config.cameras:
        measurements = config.read(machine)
        every = machine.parts(measurements)
        selected = machine.select(every, config.joints, config.pads)
        spsa_seed = config.seed if config.method == "spsa" else None
        if spsa_seed is not None and not {*selected} & {*SIGNALS}:
            raise TaccorlError(NO_JOINT)
        fit = partial(
            align_parts,
            selected,
            machine.config,
            measurements,
            fit_kp=config.fit_kp or spsa_seed is not None,
            spsa_seed=spsa_seed,
            workers=config.workers,
        )
        only = selected if config.joints and not config.pads else ()
        aligned_parts = _joints_and_pads(
            machine, measurements, selected, config.accept, only, fit
        )
        if aligned_parts is None:
            return 1
        found += aligned_parts
    found += _cameras(config.cameras, machine, config.measurements, config.spec)
    twin, disagree = aligned(machine.config, found)
    show(*map(_section, found), Section(text=[disagree] * bool(disagree)))
    good = [one.part for one in found if not one.trouble]
    report = {
        "command": shlex.join(["taccorl", "align", *argv]),
        "twin": str(config.twin) if config.twin else "nominal twin",
        "twin, SHA-256": machine.digest(),
        "not written": disagree,
        "parts": plain([one.record() for one in found]),
    }
    config.out.mkdir(parents=True, exist_ok=True)
    (config.out / REPORT).write_text(
        json.dumps(report, indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
    )
    _write_overlays(config.out, found)
    if not good:
        show(
            Section(
                text=[
                    f"wrote {config.out / REPORT}; no twin, since nothing was aligned"
                ]
            )
        )
        return 1
    save_twin(twin, config.out / TWIN)
    changed = [one.part for one in found if not (one.trouble or one.unchanged)]
    what = f"{config.out / TWIN} ({', '.join(changed)})"
    if not changed:
        what = f"{config.out / TWIN}, in which nothing changed,"
    options = {
        name: getattr(config, name) for name in ("spec", "columns", "validation_every")
    }
    given = [
        f"--{name}={value}" for name, value in options.items() if value is not None
    ]
    if any(
        one.floors_left >= FAR_ABOVE_FLOOR for one in found
    ):  # fitted gains hide a part of what is to be found
        given += [f"--twin={config.twin}"] * (config.twin is not None)
    else:
        given.append(f"--twin={config.out / TWIN}")
    words = shlex.join(["taccorl", "diagnose", str(config.measurements), *given])
    show(Section(text=[f"wrote {what} and {REPORT}", f"next: {words}"]))
    return int(len(good) < len(found) or bool(disagree))


def _joints_and_pads(
    machine: "PiperTwin",
    measurements: "Measurements",
    selected: Sequence[str],
    accept: Sequence[str],
    only: Sequence[str],
    fit: "Callable[..., list[Alignment]]",
) -> "list[Alignment] | None":
    """Alignments of the parts ``selected`` by ``fit``; None if the measurements have errors.
    ``accept``, ``only``: as of ``replayed``."""
    from taccorl.alignment.checks.clock import SHIFTED
    from taccorl.cli.progress import Bars
    from taccorl.diagnosis.problems.joints import of_joints

    judged = () if SHIFTED in accept else selected
    shifted: list[str] = []

    def replay() -> "Comparison":
        with Bars(len(measurements.all)) as bars:
            found = machine.compare(measurements, progress=bars.update)
        shifted.extend(s for s in judged if _is_shifted(found, s))
        clock = {
            name: tuple(_of_gains(f) if f.feature in judged else f for f in own)
            for name, own in found.clock.items()
        }
        return dataclasses.replace(found, clock=clock)

    beside = replayed(
        machine,
        measurements,
        "not aligned",
        accept,
        replay,
        "changes every gain",
        only=only,
    )
    if beside is None:
        return None
    before = beside.comparison
    with Bars(len(selected), f"fitting {len(selected)} parts") as bars:
        count = itertools.count(1)
        found = fit(done=lambda part: bars.update(part, next(count), len(selected)))
    changed = [one.part for one in found if not (one.trouble or one.unchanged)]
    joints = [s for s in changed if before.of(s)]
    if joints or shifted:
        own = of_joints(measurements, [*joints, *shifted], touch=False)
        found = _beside_fitted(machine, found, own, before, shifted)
    floors = {
        (s.signal, s.use): s.floor for s in before.scores() if s.kind == "position"
    }
    use = "validation" if measurements.validation else "fit"
    return [_beside_floor(one, floors.get((one.part, use))) for one in found]


def _is_shifted(
    comparison: "Comparison", signal: str, severity: str | None = None
) -> bool:
    """True if most recordings that move ``signal`` are shifted from the replay.
    ``severity``: only findings of this one."""
    found = [f for own in comparison.clock.values() for f in _shifts(own, signal)]
    found = [f for f in found if severity in (None, f.severity)]
    return 2 * len(found) > len(comparison.of(signal))


def _shifts(findings: Sequence[Finding], signal: str) -> list[Finding]:
    from taccorl.alignment.checks.clock import SHIFTED

    return [f for f in findings if (f.check, f.feature) == (SHIFTED, signal)]


def _of_gains(f: Finding) -> Finding:
    """A shift from the replay before gains are fitted, as a warning without a way out."""
    from taccorl.alignment.checks.clock import SHIFTED

    if f.check != SHIFTED:
        return f
    size, rows, _ = f.text.partition("rows)")
    text = f"{size}{rows}: other gains look like this, too"
    text += "; it is judged again beside the fitted ones"
    return dataclasses.replace(f, severity="warning", text=text)


def _beside_fitted(
    machine: "PiperTwin",
    found: "list[Alignment]",
    measurements: "Measurements",
    before: "Comparison",
    shifted: Sequence[str],
) -> "list[Alignment]":
    """``found``, judged by replays with the fitted gains. Joints whose angles are further
    off in the recordings that judge them, or that are shifted with these gains as well,
    are not aligned; other errors that rise are remarks.

    Args:
        measurements: of the joints that were changed.
        before: replays with the twin's own gains.
        shifted: joints that were shifted in these.
    """
    from taccorl.alignment.checks.clock import SHIFTED
    from taccorl.diagnosis.align import aligned

    twin, _ = aligned(machine.config, found)
    again = dataclasses.replace(machine, config=twin).compare(measurements)
    result = []
    for one in found:
        trouble, remarks = one.trouble, one.remarks
        larger = _larger(before, again, one.part)
        judge = "validation" if measurements.validation else "fit"
        if ("position", judge) in larger:
            trouble = trouble or larger.pop(("position", judge))
        if one.part in shifted:
            if not trouble and _is_shifted(again, one.part, "error"):
                own = [f for c in again.clock.values() for f in _shifts(c, one.part)]
                trouble = f"{own[0].text}; --accept={SHIFTED} aligns nevertheless"
            trouble = trouble or _late(again, one.part)
        if not (trouble or one.unchanged):
            remarks = (*larger.values(), *remarks)
        result.append(dataclasses.replace(one, trouble=trouble, remarks=remarks))
    return result


def _larger(
    before: "Comparison", after: "Comparison", part: str
) -> dict[tuple[str, str], str]:
    """(kind, use) of each error of a joint that rises by more than ``SAME``, with the
    sentence that says so."""
    found = {}
    for new in (s for s in after.scores() if s.signal == part):
        old = before.score(part, new.kind, new.use) if new.kind != "touch" else None
        if old is None or new.rmse <= (1.0 + SAME) * old.rmse:
            continue
        found[new.kind, new.use] = (
            f"the {new.kind} error of {new.use} recordings is larger with the fitted "
            f"gains: {old.ratio:.4g} → {new.ratio:.4g} noise floors"
        )
    return found


def _late(comparison: "Comparison", part: str) -> str:
    """Why the fitted gains of a joint are not written: most of its recordings come
    ``LATE_S`` or more after the replay with them; empty if they do not."""
    import numpy as np

    from taccorl.alignment.checks.clock import SHIFTED
    from taccorl.alignment.checks.first_order import delay_between

    if not _is_shifted(comparison, part):
        return ""
    traces = comparison.of(part)
    shifted = [
        t for t in traces if _shifts(comparison.clock.get(t.recording, ()), part)
    ]
    delays_s = [
        delay_between(
            t.target, t.measured, t.replayed, float(np.median(np.diff(t.time_s)))
        ).delay_s
        for t in shifted
    ]
    if (delay_s := float(np.median(delays_s))) < LATE_S:
        return ""
    return (
        f"its measurement comes {1e3 * delay_s:.0f} ms after the replay, in {len(shifted)} of {len(traces)} recordings, with the "
        "fitted gains as well: a clock offset, or a delay that the twin lacks, which these gains take up in part. Log command "
        f"and measurement by one clock, or find the delay with taccorl diagnose; --accept={SHIFTED} aligns nevertheless"
    )


def _beside_floor(one: "Alignment", floor: float | None) -> "Alignment":
    """With the error that is left in noise floors, and a remark if that is much more than noise."""
    left = (
        (one.before if one.trouble or one.unchanged else one.after) / floor
        if floor
        else math.nan
    )
    if not left >= FAR_ABOVE_FLOOR:
        return dataclasses.replace(one, floors_left=left)
    remark = (
        f"{left:.3g} noise floors are left: the twin lacks an effect, or a clock is off (see above), and fitted gains "
        "take up part of it. Find it with taccorl diagnose, add it, then align again"
    )
    return dataclasses.replace(one, floors_left=left, remarks=(remark, *one.remarks))


def _check_cameras(
    cameras: Sequence[str], machine: "PiperTwin", path: Path, spec: str | None
) -> None:
    """Raises TaccorlError: the twin has no such camera, or the recording at ``path`` has no episode with pictures."""
    if not cameras:
        return
    from taccorl.cli.view import opened_episode

    known = [camera.name for camera in machine.config.cameras]
    for name in cameras:
        if name not in known:
            raise TaccorlError(
                f"--cameras={name}: the twin has no such camera; {nearest(name, known)}"
            )
    try:
        with opened_episode(path, 0, spec, "--spec"):
            pass
    except TaccorlError as error:
        raise TaccorlError(
            f"--cameras={','.join(cameras)} needs one recording or dataset: {error}"
        ) from error


def _cameras(
    cameras: Sequence[str], machine: "PiperTwin", path: Path, spec: str | None
) -> "list[Alignment]":
    if not cameras:
        return []
    from taccorl.cli.progress import Bars
    from taccorl.cli.view import opened_episode
    from taccorl.diagnosis.align import align_camera

    found, num = [], len(cameras)
    with (
        opened_episode(path, 0, spec, "--spec") as episode,
        Bars(num, "reading pictures") as bars,
    ):
        for k, name in enumerate(cameras):
            bars.update(name, k, num)
            found.append(align_camera(name, machine.config, episode))
    return found


def _section(one: "Alignment") -> Section:
    lines = [Cell(f"not aligned: {one.trouble}", "error")] if one.trouble else []
    if one.unchanged:
        text = "the recordings agree with the twin's numbers, which stay as they are"
        if one.floors_left >= FAR_ABOVE_FLOOR:
            text = (
                "no other gains leave a smaller error: the twin's stay, although they "
                f"leave {one.floors_left:.3g} noise floors"
            )
        lines.append(Cell(text))
    if not one.numbers:
        return Section(title=one.part, text=lines)
    rows = []
    for n in one.numbers:
        interval = "not fitted" if n.fixed else f"{n.low:.4g} … {n.high:.4g}"
        rows.append([n.name, f"{n.before:.4g}", f"{n.value:.4g}", interval, n.unit])
    parts = []
    if one.touch_matches:
        from taccorl.report.touch_match import touch_match_section

        parts.append(touch_match_section(("before", "fitted"), one.touch_matches))
    is_kept = one.unchanged or bool(one.trouble)
    remarks = [
        f"{one.error_name}: {one.before:.3g} → {one.after:.3g}"
        + ", with fitted numbers that are not written" * is_kept,
        *(f"Remark: {remark}" for remark in one.remarks),
    ]
    return Section(
        title=one.part,
        text=[
            *lines,
            f"fitted to {listed([*one.fitted_to], 3)}; judged by {listed([*one.judged_by], 3)}",
        ],
        heads=("number", "before", "fitted", "95 % interval", "unit"),
        rows=rows,
        right=range(1, 4),
        parts=[*parts, Section(text=remarks)],
    )


def _write_overlays(folder: Path, found: "Sequence[Alignment]") -> None:
    for one in found:
        for stage, picture in one.overlays.items():
            import cv2

            cv2.imwrite(
                str(folder / f"{one.part.replace(' ', '_')}_{stage}.png"),
                picture[..., ::-1],
            )
