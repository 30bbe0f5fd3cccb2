"""``taccorl diagnose`` beside MuJoCo's sysid and scipy: ``make bench ONLY=peers``.

An arm of three joints is simulated by plain MuJoCo, its elbow moves, and its encoders have
noise; nothing of it comes from taccorl, and no recording is of a real robot. Each contestant
reads the same recordings in a process of its own: ``taccorl diagnose --until=noise_floor``
by its command, the peers by ``peer_fits``; scipy for the first seed alone, as it ends where
sysid ends. Nobody is told what is hidden. The peers free all numbers that MuJoCo has for it,
and their step is the one that made the recordings.

mujoco.sysid needs ``pip install 'mujoco[sysid]'``. ``python -m pipelines.benchmarks.peers
FOLDER [CASE …]`` keeps what is written and prints the table of numbers.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np

from pipelines.benchmarks import peer_fits
from pipelines.benchmarks.rows import Row, benchmark
from taccorl.errors import TaccorlError

NOISE_RAD = 2e-4
"""Standard deviation of an encoder's noise [rad]: the noise floor."""
SEEDS = (0, 1, 2)
FRICTION = ("coulomb_friction", "soft_friction")
DELAY = ("command_delay", "sensor_delay")
DAMPING = ("viscous_friction",)
EFFECTS_OF = {"frictionloss": FRICTION, "delay_s": DELAY, "damping": DAMPING}
"""Number of MuJoCo → effects of taccorl that are this number."""
LEAST = {"frictionloss": 1e-3, "delay_s": 1e-5, "damping": 1e-3}
"""Number below which a peer's fit says that there is none, as at a bound; SI units."""
HIDDEN: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "clean": {},
    "friction": {"frictionloss": (0.25, 0.7)},
    "delay": {"delay_s": (0.0248, 0.0248)},
    "friction and delay": {"frictionloss": (0.25, 0.7), "delay_s": (0.0248, 0.0248)},
    "damping": {"damping": (0.4, 1.2)},
    "soft friction and damping": {"frictionloss": (0.25, 0.7), "damping": (0.4, 1.2)},
}
"""Case → hidden numbers of the elbow, each with the range it is drawn from; SI units."""
WRONG_GAINS = {"kp": 1.6, "kd": 0.6}
"""What the file of the clean arm states over what its drive runs."""
STIFF = 'solreffriction="0.004 1" solimpfriction="0.99 0.999 0.001"'
"""MuJoCo's settings for dry friction that holds a joint still, where its default lets it creep. Used in all cases whose name
lacks ``soft``, in the simulated arm and in the model that each contestant is given."""


@dataclass(frozen=True)
class Arm:
    """The simulated arm of a case."""

    case: str
    """Key of ``HIDDEN``."""
    seed: int

    def _rng(self, stream: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, list(HIDDEN).index(self.case), stream])

    @property
    def hidden(self) -> dict[str, float]:
        """Hidden numbers of the elbow; SI units."""
        rng = self._rng(0)
        return {name: float(rng.uniform(*r)) for name, r in HIDDEN[self.case].items()}

    @property
    def gains(self) -> dict[str, float]:
        """K_p [N·m/rad] and K_d [N·m·s/rad] that the elbow's drive runs."""
        rng = self._rng(1)
        kp = round(float(rng.uniform(35.0, 70.0)), 2)
        return {"kp": kp, "kd": round(float(rng.uniform(0.12, 0.2)) * kp**0.5 * 3, 3)}

    @property
    def stated_gains(self) -> dict[str, float]:
        """Gains of the elbow that the user's file states."""
        off = WRONG_GAINS if self.case == "clean" else {}
        return {name: value * off.get(name, 1.0) for name, value in self.gains.items()}

    @property
    def user_xml(self) -> str:
        """The user's MJCF: without what is hidden, with the stated gains."""
        friction = "" if self.case.startswith("soft") else STIFF
        elbow = self.stated_gains
        links = (
            ("pan", "0 0 1", "0 0 0.12", 2.5, 0.10, (150.0, 12.0)),
            ("lift", "0 1 0", "0.30 0 0", 2.8, 0.10, (400.0, 30.0)),
            ("elbow", "0 1 0", "0.28 0 0", 1.8, 0.06, (elbow["kp"], elbow["kd"])),
        )
        inner, motors, at = "", "", [(0, 0, 0.5), (0, 0, 0.12), (0.3, 0, 0)]
        for (name, axis, end, mass, rotor, (kp, kd)), pos in zip(
            reversed(links), reversed(at), strict=True
        ):
            middle = np.array([float(x) for x in end.split()]) / 2
            inner = (
                f'<body name="{name}_link" pos="{pos[0]} {pos[1]} {pos[2]}">'
                f'<joint name="{name}" axis="{axis}" range="-3 3" armature="{rotor}" '
                f"{friction if name == 'elbow' else ''}/>"
                f'<inertial pos="{middle[0]} {middle[1]} {middle[2]}" mass="{mass}" '
                f'diaginertia="0.004 0.016 0.016"/>{inner}</body>'
            )
            motors = (
                f'<position name="{name}" joint="{name}" kp="{kp}" kv="{kd}"/>{motors}'
            )
        return (
            '<mujoco><compiler angle="radian"/>'
            f'<option timestep="{peer_fits.STEP_S}" integrator="implicitfast"/>'
            f"<worldbody>{inner}</worldbody><actuator>{motors}</actuator>"
            '<sensor><jointpos name="elbow_pos" joint="elbow"/></sensor></mujoco>'
        )

    def move(self, target: np.ndarray, numbers: Mapping[str, float]) -> np.ndarray:
        """Angles (T, J) [rad] of MuJoCo with ``numbers`` of the elbow, without noise."""
        return peer_fits.simulated(self.user_xml, numbers, target)

    def predicted(self, target: np.ndarray, numbers: Mapping[str, float]) -> np.ndarray:
        """Angles (T,) [rad] of the elbow by a peer's numbers: its delay is one of readings,
        which may be shorter than a step."""
        own = {name: value for name, value in numbers.items() if name != "delay_s"}
        angle = self.move(target, own)[:, peer_fits.ELBOW]
        rows_s = np.arange(len(target)) / peer_fits.RATE_HZ
        return np.interp(rows_s - numbers["delay_s"], rows_s, angle)

    def measured(self, target: np.ndarray, stream: int) -> np.ndarray:
        """Angles (T, J) [rad] of the true arm, with noise."""
        angles = self.move(target, {**self.gains, **self.hidden})
        return angles + NOISE_RAD * self._rng(stream).normal(size=angles.shape)

    def write(self, folder: Path) -> None:
        """Write the model, the robot file and the recordings of its user."""
        (folder / "sweeps").mkdir(parents=True)
        (folder / "arm.xml").write_text(self.user_xml)
        known = "fitted" if self.case == "clean" else "commanded"
        stated = self.stated_gains
        (folder / "gains.json").write_text(json.dumps({"gains": known, **stated}))
        elbow = f"kp: {stated['kp']}, kd: {stated['kd']}, gains: {known}, rotor_inertia: 0.06"
        (folder / "arm.yaml").write_text(
            "kind: robot\nmodel: arm.xml\ngravity_compensation: 0.0\njoints:\n"
            "  pan: {kp: 150.0, kd: 12.0, rotor_inertia: 0.1}\n"
            "  lift: {kp: 400.0, kd: 30.0, rotor_inertia: 0.1}\n"
            f"  elbow: {{{elbow}}}\n"
        )
        uses = ["recordings:"]
        for k, (name, use, motion) in enumerate(MOTIONS):
            target = targets(motion)
            angles = self.measured(target, 10 + k)
            columns = ["t", *(f"{j}.{q}" for q in ("q", "q_target") for j in JOINTS)]
            rows = np.column_stack([np.arange(len(target)) / 200, angles, target])
            np.savetxt(
                folder / "sweeps" / f"{name}.csv",
                rows,
                "%.7f",
                delimiter=",",
                header=f"# domain: surrogate\n# origin: {ORIGIN}\n{','.join(columns)}",
                comments="",
            )
            uses.append(f"  {name}.csv: {{{use}}}")
        (folder / "sweeps" / "measurements.yaml").write_text("\n".join(uses) + "\n")


ORIGIN = "simulated arm of plain MuJoCo (pipelines.benchmarks.peers)"
JOINTS = ("pan", "lift", "elbow")
POSE_RAD = (0.3, -0.5, 1.0)


def targets(motion: np.ndarray) -> np.ndarray:
    """Targets (T, J) [rad]: the elbow moves by ``motion`` (T,) [rad], the others stand."""
    rows = np.tile(POSE_RAD, (len(motion), 1))
    rows[:, peer_fits.ELBOW] += motion
    return rows


def chirp(seconds: float, low_hz: float, high_hz: float, size_rad: float) -> np.ndarray:
    """Sweep of (T,) rows [rad] that begins and ends at rest."""
    t = np.arange(round(seconds * peer_fits.RATE_HZ)) / peer_fits.RATE_HZ
    active = np.clip(t - 0.5, 0.0, None)
    turns = low_hz * active + (high_hz - low_hz) * active**2 / (2 * seconds)
    window = np.clip(active / 0.5, 0.0, 1.0) * np.clip((seconds - t) / 0.5, 0.0, 1.0)
    return size_rad * window * np.sin(2 * np.pi * turns)


def triangle(seconds: float, size_rad: float) -> np.ndarray:
    """Triangle of (T,) rows [rad] with half a second of rest at both ends."""
    t = np.arange(round(seconds * peer_fits.RATE_HZ)) / peer_fits.RATE_HZ
    share = np.clip((t - 0.5) / (seconds - 1.0), 0.0, 1.0)
    return size_rad * np.interp(2 * share % 1.0, [0, 0.25, 0.75, 1], [0, 1, -1, 0])


def steps(levels_rad: Sequence[float]) -> np.ndarray:
    """Levels (T,) [rad] of a second each, reached at 4 rad/s."""
    t = np.arange(len(levels_rad) * peer_fits.RATE_HZ) / peer_fits.RATE_HZ
    rows = np.zeros_like(t)
    for begin, change in enumerate(np.diff(levels_rad, prepend=0.0)):
        rows += np.sign(change) * np.clip((t - begin) * 4.0, 0.0, abs(change))
    return rows


MOTIONS = (
    ("one", "use: fit", chirp(10.0, 0.1, 2.5, 0.3)),
    ("again", "use: fit, repeat_of: one.csv", chirp(10.0, 0.1, 2.5, 0.3)),
    ("triangle", "use: fit", triangle(8.0, 0.5)),
    ("held", "use: validation", chirp(8.0, 0.15, 2.0, 0.25)),
    ("steps", "use: validation", steps((0.0, 0.2, -0.25, 0.35, 0.3, -0.35, 0.1, 0.0))),
)
"""Name, use and motion [rad] of each recording."""
HELD_OUT = (
    chirp(8.0, 0.1, 2.2, 0.28),
    steps((0.0, -0.3, 0.15, 0.4, -0.1, -0.12, 0.25, 0.0)),
)
"""Motions that nobody has seen [rad]."""


@dataclass(frozen=True)
class Outcome:
    """What one contestant found of one arm."""

    numbers: dict[str, float]
    """Names of MuJoCo → values; SI units."""
    named: frozenset[str]
    """Hidden numbers that it names: effects that the diagnosis added; of a peer, numbers
    above ``LEAST`` and the half width of their 95 % interval."""
    floors: float
    """Root mean square error of the held-out motions, in standard deviations of noise."""
    fit_s: float
    """CPU-seconds without imports."""
    imports_s: float
    search_s: float
    """CPU-seconds of the fits alone: a diagnosis also checks the recordings, compares the
    files and draws a report."""


Held = Sequence[tuple[np.ndarray, np.ndarray]]
"""Targets and measured angles, each (T, J) [rad], of motions that nobody has seen."""


def outcomes(arm: Arm, folder: Path) -> dict[str, Outcome]:
    """Contestant → what it found of ``arm``, whose files are written into ``folder``."""
    arm.write(folder)
    held_out = [
        (targets(motion), arm.measured(targets(motion), 90 + k))
        for k, motion in enumerate(HELD_OUT)
    ]

    def floors(predicted: Sequence[np.ndarray]) -> float:
        off = [
            p - measured[:, peer_fits.ELBOW]
            for p, (_, measured) in zip(predicted, held_out, strict=True)
        ]
        return float(np.sqrt(np.mean(np.concatenate(off) ** 2)) / NOISE_RAD)

    found = {"taccorl": _diagnosed(folder, held_out, floors)}
    for peer in ("sysid", "scipy")[: 1 + (arm.seed == SEEDS[0])]:
        words = [sys.executable, "-m", "pipelines.benchmarks.peer_fits", peer, folder]
        answer = json.loads(_run(words)[0].splitlines()[-1])
        numbers, half = answer["numbers"], answer["half"]
        moved = [arm.predicted(t, numbers) for t, _ in held_out]
        named = {
            n
            for n in EFFECTS_OF
            if numbers.get(n, 0.0) > max(half.get(n, 0.0), LEAST[n])
        }
        found[peer] = Outcome(
            numbers,
            frozenset(named),
            floors(moved),
            answer["fit_s"],
            answer["imports_s"],
            answer["fit_s"],
        )
    return found


def _run(words: Sequence[object]) -> tuple[str, float]:
    """Run a command with one thread for each process. Returns its output, and the CPU time of it and of its children [s]."""
    threads = {f"{n}_NUM_THREADS": "1" for n in ("OMP", "OPENBLAS", "NUMBA")}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [str(word) for word in words],
        env={**os.environ, **threads},
        capture_output=True,
        text=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    # diagnose returns 1 where something is missing that it cannot name.
    if done.returncode not in (0, 1) or (done.returncode and "diagnose" not in words):
        shown = " ".join(map(str, words))
        raise TaccorlError(f"{shown}: exit {done.returncode}: {done.stderr[-600:]}")
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return done.stdout, used


def _diagnosed(
    folder: Path, held_out: Held, floors: Callable[[Sequence[np.ndarray]], float]
) -> Outcome:
    from taccorl.alignment.measurements.measurement import Measurement
    from taccorl.diagnosis.machines.load import load_machine

    _, imports_s = _run([sys.executable, "-c", IMPORTS])
    out = folder / "diagnosis"
    taccorl = [sys.executable, "-m", "taccorl.cli.main", "diagnose", folder / "sweeps"]
    options = [f"--twin={folder / 'arm.yaml'}", "--until=noise_floor", f"--out={out}"]
    _, used_s = _run([*taccorl, *options, "--joints=[elbow]"])
    written = out / "arm.yaml"
    machine = load_machine(written if written.exists() else folder / "arm.yaml")
    moved = [
        machine.answer(
            "elbow",
            Measurement(
                name=f"held out {k}",
                time_s=np.arange(len(target)) / peer_fits.RATE_HZ,
                target=target,
                measured=measured,
                signals=JOINTS,
                units=("rad",) * len(JOINTS),
            ),
        ).reported
        for k, (target, measured) in enumerate(held_out)
    ]
    found = json.loads((out / "report.json").read_text())["diagnoses"]["elbow"]
    added = {e["effect"] for e in found["effects"]} - {*found["present"]}
    own = {name for names in EFFECTS_OF.values() for name in names}
    named = {n for n, names in EFFECTS_OF.items() if added & {*names}}
    return Outcome(
        {name: value for name, (value, _) in machine.numbers("elbow").items()},
        frozenset(named | (added - own)),
        floors(moved),
        used_s - imports_s,
        imports_s,
        found["cpu_s"],
    )


IMPORTS = (
    "import taccorl.cli.diagnose, taccorl.report.diagnosed, taccorl.diagnosis.search.search"
    ", taccorl.diagnosis.machines.robot, taccorl.alignment.controller.lanes"
)
"""What the command imports before it reads a recording."""


def all_outcomes(folder: Path, cases: Sequence[str]) -> dict[Arm, dict[str, Outcome]]:
    """What each contestant found of each arm; an arm that ``folder`` has is not run again.

    ``compile_s.json`` of the folder has the CPU-seconds of Numba's compilation, which the
    first diagnosis on a machine takes.
    """
    folder.mkdir(parents=True, exist_ok=True)
    warm = folder / "warm"
    if not warm.exists():
        Arm("clean", 99).write(warm)
        _diagnosed(warm, (), lambda predicted: 0.0)
    found = {}
    for arm in (Arm(case, seed) for case in cases for seed in SEEDS):
        kept = folder / f"{arm.case} {arm.seed}.json"
        if not kept.exists():
            own = outcomes(arm, folder / f"{arm.case} {arm.seed}")
            kept.write_text(
                json.dumps({k: vars(o) for k, o in own.items()}, default=list)
            )
        facts = json.loads(kept.read_text())
        found[arm] = {
            name: Outcome(**{**own, "named": frozenset(own["named"])})
            for name, own in facts.items()
        }
    return found


@benchmark("peers")
def peers() -> Iterator[Row]:
    """CPU-seconds, held-out error and answers of a diagnosis over those of its peers."""
    with tempfile.TemporaryDirectory() as folder:
        yield from rows_of(all_outcomes(Path(folder), tuple(HIDDEN)))


def rows_of(found: Mapping[Arm, Mapping[str, Outcome]]) -> Iterator[Row]:
    """Rows of each case, and of all cases the answers."""
    for case in dict.fromkeys(arm.case for arm in found):
        every = [of for arm, of in found.items() if arm.case == case]
        subject = case.replace(" ", "_")
        for peer, goal in (("sysid", "≤ 0.5"), ("scipy", "")):
            own = [of for of in every if peer in of]
            yield Row.of(
                [of["taccorl"].fit_s / of[peer].fit_s for of in own],
                name=f"{subject}: CPU-s of diagnose over {peer}'s, without imports",
                unit="×",
                goal=goal,
                rival=f"{peer}, CPU-s",
                rival_value=median(of[peer].fit_s for of in own),
            )
            yield Row.of(
                [of["taccorl"].search_s / of[peer].fit_s for of in own],
                name=f"{subject}: CPU-s of its search alone over {peer}'s",
                unit="×",
                goal=goal,
                rival=f"{peer}, CPU-s",
                rival_value=median(of[peer].fit_s for of in own),
            )
            yield Row.of(
                [of["taccorl"].floors / of[peer].floors for of in own],
                name=f"{subject}: error on held-out motions over {peer}'s",
                unit="×",
                goal="≤ 1.005" if peer == "sysid" else "",
                rival=f"{peer}, noise floors",
                rival_value=median(of[peer].floors for of in own),
            )
    for name, goal in (("taccorl", "≥ 100"), ("sysid", ""), ("scipy", "")):
        own = {arm: of[name] for arm, of in found.items() if name in of}
        right = [one.named == set(arm.hidden) for arm, one in own.items()]
        yield Row(
            name=f"arms of which {name} names what is hidden and nothing else",
            value=100 * sum(right) / len(right),
            unit="%",
            goal=goal,
            n=len(right),
            spread=0.0,
        )
        yield Row.of(
            [one.imports_s for one in own.values()],
            name=f"imports of {name}, CPU-s",
            unit="s",
        )


def table(found: Mapping[Arm, Mapping[str, Outcome]]) -> Iterator[str]:
    """Lines of a Markdown table: for each simulated arm the true numbers, and those that taccorl, sysid and SciPy found."""
    yield "| arm | who | CPU-s | floors | names | numbers |"
    yield "|---|---|---|---|---|---|"
    for arm, of in found.items():
        true = {**(arm.gains if arm.case == "clean" else {}), **arm.hidden}
        shown = ", ".join(f"{k} {v:.4g}" for k, v in true.items()) or "–"
        yield f"| {arm.case}, {arm.seed} | true | | | | {shown} |"
        for name, own in of.items():
            synonyms = {
                n: [n, *(key for key in own.numbers if key.split(".")[0] in names)]
                for n, names in EFFECTS_OF.items()
            }
            numbers = ", ".join(
                f"{key} {own.numbers[key]:.4g}"
                for n in dict.fromkeys((*true, *own.named))
                for key in synonyms.get(n, [n, *_numbers_of(n, own.numbers)])
                if key in own.numbers
            )
            yield (
                f"| | {name} | {own.fit_s:.1f} ({own.search_s:.1f}) | {own.floors:.3f} "
                f"| {', '.join(sorted(own.named)) or '–'} | {numbers or '–'} |"
            )


def _numbers_of(effect: str, numbers: Mapping[str, float]) -> list[str]:
    return [key for key in numbers if key.startswith(f"{effect}.")]


if __name__ == "__main__":
    for line in table(all_outcomes(Path(sys.argv[1]), sys.argv[2:] or tuple(HIDDEN))):
        print(line)
