"""``taccorl surrogate --secret=7 [--pads=left] [--out=outputs/surrogate_7] [--effects=[coulomb_friction]] [--design=pack]``

Write recordings of a simulated robot with hidden effects, drawn from the seed, to try ``taccorl compare`` and ``diagnose``
without a robot. The simulation is independent of the twin: other equations, finer steps, bristle friction, a sampled controller.
With --pads its fingers press known objects, and the hidden effects are in the pads. With --cells=true it is a simulated sensor
of force cells, for a cells file (``taxel.yaml``). The hidden effects are in a sealed file; ``taccorl surrogate
--reveal=outputs/surrogate_7`` prints it.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from taccorl.cli.parse import parse
from taccorl.errors import TaccorlError
from taccorl.lineage.destinations import is_free


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


def main(argv: list[str]) -> int:
    """Run ``taccorl surrogate``; returns its exit status."""
    return run(parse(SurrogateConfig, argv, positional=None))


def run(config: SurrogateConfig) -> int:
    """Exit status 0: written."""
    from taccorl.surrogate.writing import SWEEPS, TWIN, reveal

    if config.reveal is not None:
        print(json.dumps(reveal(config.reveal), indent=2, ensure_ascii=False))
        return 0
    if config.secret is None:
        raise TaccorlError("missing --secret=, a whole number of at least 0; --help says more")
    if config.secret < 0:
        raise TaccorlError(f"--secret={config.secret}: at least 0")
    out = config.out or Path("outputs") / f"surrogate_{config.secret}"
    if not is_free(out):
        raise TaccorlError(f"{out}: is there already; give another --out, or remove it")
    if config.cells:
        return _cells(config, config.secret, out)
    made = _sweeps(config, config.secret, out) if config.pads == "no" else _presses(config, config.secret, out)
    print(f"{made} in {out / SWEEPS}: a simulated robot, not a real one")
    print(f"next: taccorl compare --twin={out / TWIN} --measurements={out / SWEEPS}")
    print(f"then: taccorl diagnose --twin={out / TWIN} --measurements={out / SWEEPS}")
    print(f"last: taccorl surrogate --reveal={out}")
    return 0


def _cells(config: SurrogateConfig, secret: int, out: Path) -> int:
    from taccorl.surrogate.cells import HIDDEN, PRESSES, SENSOR, draw_cells, write_cells

    plain = SurrogateConfig()
    others = [
        n for n in ("pads", "signal", "strength", "gains_known", "design") if getattr(config, n) != getattr(plain, n)
    ]
    if others:
        raise TaccorlError(f"--{others[0]} is of robots; leave it out with --cells=true")
    hidden = [list(HIDDEN)[secret % len(HIDDEN)]] if config.effects is None else config.effects
    if len(hidden) > 1:
        raise TaccorlError(f"--effects: {len(hidden)} effects; a simulated sensor of cells hides one or none")
    count = write_cells(draw_cells("".join(hidden), secret), out)
    print(f"{count} recordings of a sensor of cells in {out / PRESSES}: simulated, not a real one")
    print(f"next: taccorl compare {out / PRESSES} --twin={out / SENSOR}")
    print(f"then: taccorl diagnose {out / PRESSES} --twin={out / SENSOR}")
    print(f"last: taccorl surrogate --reveal={out}")
    return 0


def _sweeps(config: SurrogateConfig, secret: int, out: Path) -> str:
    from taccorl.surrogate.cases import draw_case, draw_secret
    from taccorl.surrogate.writing import write_recordings

    case = draw_case(
        draw_secret(secret) if config.effects is None else config.effects,
        secret,
        signal=config.signal,
        strength=config.strength,
        gains_known=config.gains_known,
        design=config.design,
    )
    return f"{len(write_recordings(case, out).all)} recordings of {case.signal}"


def _presses(config: SurrogateConfig, secret: int, out: Path) -> str:
    from taccorl.surrogate.touch import draw_touch_case
    from taccorl.surrogate.writing import draw_touch_secret, write_touch_recordings

    plain = SurrogateConfig()
    of_joints = [name for name in ("signal", "gains_known", "design") if getattr(config, name) != getattr(plain, name)]
    if of_joints:
        raise TaccorlError(f"--{of_joints[0]} is of joints; leave it out with --pads={config.pads}")
    case = draw_touch_case(
        draw_touch_secret(secret) if config.effects is None else config.effects,
        secret,
        arm=None if config.pads == "drawn" else config.pads,
        strength=config.strength,
    )
    made = write_touch_recordings(case, out)
    return f"{len(made.pressed)} recordings of the {case.arm} pads, which press known objects,"
