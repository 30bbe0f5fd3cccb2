"""``taccorl surrogate --secret=7 [--out=outputs/surrogate_7] [--effects=[coulomb_friction]] [--design=pack]``

Recordings of a robot that is not there, with effects hidden in it that the seed draws, for ``taccorl compare`` and ``diagnose``.
It is a simulation of its own, apart from the twin: other equations, finer steps, friction of bristles, a sampled controller.
What is hidden lies in a sealed file; ``taccorl surrogate --reveal=outputs/surrogate_7`` prints it.
"""

import json
from dataclasses import dataclass
from pathlib import Path

from taccorl.cli.parse import parse
from taccorl.errors import TaccorlError


@dataclass(kw_only=True)
class SurrogateConfig:
    """Recordings of a robot that is not there."""

    secret: int | None = None
    """Seed of the robot, at least 0: which joint, which gains, what is hidden and how strong."""
    out: Path | None = None
    """Folder; outputs/surrogate_SECRET if not given. It must not be there yet."""
    effects: list[str] | None = None
    """What is hidden, instead of what the seed draws; [] for nothing."""
    signal: str | None = None
    """Joint under test, as left_joint5; drawn if not given."""
    strength: float | None = None
    """Noise floors that each effect leaves after a refit of the gains; 1 to 30 if not given."""
    design: str = "pack"
    """What is recorded for fitting: chirp (10 s, twice), or pack."""
    gains_known: bool = False
    """The commanded gains are the drive's, and written down."""
    reveal: Path | None = None
    """Print what is hidden in this folder's robot, and do nothing else."""


def main(argv: list[str]) -> int:
    """0: written."""
    config = parse(SurrogateConfig, argv, positional=None)
    from taccorl.diagnosis.surrogate.cases import draw_case, draw_secret
    from taccorl.diagnosis.surrogate.writing import SWEEPS, TWIN, reveal, write_recordings

    if config.reveal is not None:
        print(json.dumps(reveal(config.reveal), indent=2, ensure_ascii=False))
        return 0
    if config.secret is None or config.secret < 0:
        raise TaccorlError("missing --secret=, a whole number of at least 0; --help says more")
    names = draw_secret(config.secret) if config.effects is None else config.effects
    case = draw_case(
        names,
        config.secret,
        signal=config.signal,
        strength=config.strength,
        gains_known=config.gains_known,
        design=config.design,
    )
    out = config.out or Path("outputs") / f"surrogate_{config.secret}"
    if out.exists():
        raise TaccorlError(f"{out}: is there already; give another --out, or remove it")
    made = write_recordings(case, out)
    print(f"{len(made.all)} recordings of {case.signal} in {out / SWEEPS}: a simulated robot, not a real one")
    print(f"next: taccorl compare --twin={out / TWIN} --measurements={out / SWEEPS}")
    print(f"then: taccorl diagnose --twin={out / TWIN} --measurements={out / SWEEPS}")
    print(f"last: taccorl surrogate --reveal={out}")
    return 0
