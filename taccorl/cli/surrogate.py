"""``taccorl surrogate --secret=7 [--pads=left] [--out=outputs/surrogate_7] [--effects=[coulomb_friction]] [--design=pack]``

Write recordings of a simulated robot with hidden effects, drawn from the seed, to try ``taccorl compare`` and ``diagnose``
without a robot. The simulation is independent of the twin: other equations, finer steps, bristle friction, a sampled controller.
With --pads its fingers press known objects, and the hidden effects are in the pads. With --cells=true it is a simulated sensor
of force cells, for a cells file (``taxel.yaml``). With --twin= it is the sensor of a cells file, to try the commands on it before
anything is recorded, or a PiPER with the effects that its twin.yaml states.
The hidden effects are in a sealed file; ``taccorl surrogate --reveal=outputs/surrogate_7`` prints it.
"""

import json
import math
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from taccorl.cli.output_lock import hold
from taccorl.cli.parse import refuse, verb
from taccorl.errors import TaccorlError
from taccorl.lineage.destinations import is_free

if TYPE_CHECKING:
    from taccorl.alignment.machines.cells_file import CellsConfig
    from taccorl.diagnosis.machines.machine import Machine
    from taccorl.sim.twin import TwinConfig


@dataclass(kw_only=True)
class SurrogateConfig:
    """Write recordings of a simulated robot with hidden effects."""

    secret: int | None = None
    """Seed of the robot, at least 0. It determines the joint, the gains, and the hidden effects and their strengths."""
    out: Path | None = None
    """Folder to write; outputs/surrogate_SECRET if not given. It must not exist."""
    effects: list[str] | None = None
    """Names of the hidden effects, instead of those that the seed draws; [] for none."""
    pads: Literal["no", "left", "right", "drawn"] = "no"
    """Record presses of known objects by the pads of this arm, instead of sweeps of a joint; ``drawn``: the seed chooses the
    arm."""
    cells: bool = False
    """Record presses of a sensor of force cells, instead of a robot."""
    twin: Path | None = None
    """File of a sensor of cells: record that sensor. A twin.yaml of the PiPER: its gains and effects, in all joints or in
    --signal, by the independent simulation."""
    signal: str | None = None
    """Joint that moves and has the effects, such as left_joint5; drawn if not given."""
    strength: float | None = None
    """Strength of each effect: the error, in noise floors, that remains without it after a refit of the gains. If not given,
    drawn from 1 to 30, on pads from 1.5 to 15."""
    design: str = "pack"
    """Motions of the fit recordings: chirp (10 s, twice), or pack."""
    gains_known: bool = False
    """True: the recordings state the gains that the drive really has. False: they do not."""
    reveal: Path | None = None
    """Print the hidden effects of the robot in this folder, and do nothing else."""


@verb(SurrogateConfig)
def run(config: SurrogateConfig) -> int:
    """Write the recordings, or reveal what is hidden. Returns the exit status 0."""
    from taccorl.surrogate.writing import PRESSES, SWEEPS, TWIN, reveal

    if config.reveal is not None:
        print(json.dumps(reveal(config.reveal), indent=2, ensure_ascii=False))
        return 0
    if config.secret is None:
        raise TaccorlError(
            "missing --secret=, a whole number of at least 0; --help says more"
        )
    if config.secret < 0:
        raise TaccorlError(f"--secret={config.secret}: at least 0")
    if config.strength is not None and not 0 < config.strength < math.inf:
        raise TaccorlError(
            f"--strength={config.strength:g}: a number of noise floors above 0"
        )
    out = config.out or Path("outputs") / f"surrogate_{config.secret}"
    hold(out)
    if not is_free(out):
        raise TaccorlError(f"{out}: already exists; give another --out, or remove it")
    robot = None
    if config.twin is not None:
        from taccorl.diagnosis.machines.load import load_machine
        from taccorl.diagnosis.machines.piper import PiperTwin

        machine = load_machine(config.twin)
        if not isinstance(machine, PiperTwin):
            return _machine(config, config.secret, machine, out)
        why = f"applies to a drawn robot; {config.twin} states its own"
        refuse(config, ("cells", "effects", "strength", "gains_known"), why)
        robot = machine.config
    if config.cells:
        return _cells(config, config.secret, out)
    is_arm = config.pads == "no"
    made = (_sweeps if is_arm else _presses)(config, config.secret, out, robot)
    recordings = out / (SWEEPS if is_arm else PRESSES)
    print(f"{made} in {recordings}: a simulated robot, not a real one")
    _print_next(recordings, out / TWIN, out)
    return 0


def _print_next(recordings: Path, twin: Path, out: Path) -> None:
    print(
        f"next: {shlex.join(['taccorl', 'compare', str(recordings), f'--twin={twin}'])}"
    )
    print(
        f"then: {shlex.join(['taccorl', 'diagnose', str(recordings), f'--twin={twin}'])}"
    )
    print(f"last: {shlex.join(['taccorl', 'surrogate', f'--reveal={out}'])}")


def _cells(
    config: SurrogateConfig,
    secret: int,
    out: Path,
    sensor: "CellsConfig | None" = None,
    twin: Path | None = None,
) -> int:
    """Record a made-up sensor of cells, or that of a file."""
    from taccorl.surrogate.cells import (
        HIDDEN,
        OF_GRIDS,
        SENSOR,
        draw_cells,
        write_cells,
    )
    from taccorl.surrogate.writing import PRESSES

    with_option = "--cells=true" if twin is None else f"--twin={twin}"
    of_robots = ("pads", "signal", "strength", "gains_known", "design")
    refuse(config, of_robots, f"applies to robots only; remove it with {with_option}")
    possible = [n for n in HIDDEN if sensor is None or n not in OF_GRIDS]
    hidden = (
        [possible[secret % len(possible)]] if config.effects is None else config.effects
    )
    if len(hidden) > 1:
        raise TaccorlError(
            f"--effects: {len(hidden)} effects; a simulated sensor of cells has one or none"
        )
    count = write_cells(draw_cells("".join(hidden), secret, sensor), out)
    twin = twin or out / SENSOR
    print(
        f"{count} recordings of a sensor of cells in {out / PRESSES}: simulated, not a real one"
    )
    _print_next(out / PRESSES, twin, out)
    return 0


def _machine(
    config: SurrogateConfig, secret: int, machine: "Machine", out: Path
) -> int:
    """Record the sensor of a cells file. Raises TaccorlError: it is a robot or an axis."""
    from taccorl.diagnosis.machines.cells import CellsMachine

    assert config.twin is not None
    if not isinstance(machine, CellsMachine):
        raise TaccorlError(
            f"--twin={config.twin}: a robot or an axis of your own is not simulated; "
            "without --twin= a PiPER is, and `taccorl excite` plans recordings of yours"
        )
    refuse(config, ("cells",), f"is not needed with --twin={config.twin}; remove it")
    return _cells(config, secret, out, machine.config, config.twin)


def _sweeps(
    config: SurrogateConfig, secret: int, out: Path, robot: "TwinConfig | None"
) -> str:
    from taccorl.cli.progress import Bars
    from taccorl.diagnosis.problems.joints import SIGNALS
    from taccorl.surrogate.cases import case_of, draw_case, draw_secret
    from taccorl.surrogate.writing import write_recordings

    with Bars(1, "drawing a robot") as bars:
        if robot is not None:
            signals = SIGNALS if config.signal is None else [config.signal]
            cases = [
                case_of(robot, signal, secret, config.design) for signal in signals
            ]
        else:
            drawn = draw_secret(secret) if config.effects is None else config.effects
            asked = {
                name: getattr(config, name)
                for name in ("signal", "strength", "gains_known", "design")
            }
            cases = [draw_case(drawn, secret, **asked)]
        count = write_recordings(cases, out, bars.update)
    return f"{count} recordings of {', '.join(case.signal for case in cases)}"


def _presses(
    config: SurrogateConfig, secret: int, out: Path, robot: "TwinConfig | None"
) -> str:
    from taccorl.cli.progress import Bars
    from taccorl.surrogate.touch import draw_touch_case, touch_case_of
    from taccorl.surrogate.writing import draw_touch_secret, write_touch_recordings

    refuse(
        config,
        ("signal", "gains_known", "design"),
        f"applies to joints only; remove it with --pads={config.pads}",
    )
    with Bars(1, "drawing pads") as bars:
        effects = (
            draw_touch_secret(secret) if config.effects is None else config.effects
        )
        arm = None if config.pads == "drawn" else config.pads
        case = (
            draw_touch_case(effects, secret, arm=arm, strength=config.strength)
            if robot is None
            else touch_case_of(robot, secret, arm)
        )
        made = write_touch_recordings(case, out, bars.update)
    return (
        f"{len(made.all)} recordings of the {case.arm} pads, which press known objects,"
    )
