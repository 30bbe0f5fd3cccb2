"""Twins corrected by ``taccorl diagnose`` from recordings of a surrogate, a simulated robot described by a twin file."""

import dataclasses
import shutil
from hashlib import sha256
from pathlib import Path

from pipelines.steps import step
from taccorl.cli import diagnose, surrogate
from taccorl.cli.diagnose import DiagnoseConfig
from taccorl.cli.surrogate import SurrogateConfig
from taccorl.sim.twin_file import load_twin, twin_digest
from taccorl.surrogate.writing import PRESSES, SWEEPS, TWIN


def is_folder(twin: str | Path) -> bool:
    """Whether ``twin`` is a folder of twin files."""
    return any(Path(twin).glob("*.yaml"))


def named(twin: Path) -> str:
    """Name and digest of a twin file, or of a folder of them."""
    files = sorted(twin.glob("*.yaml")) or [twin]
    digests = "".join(twin_digest(load_twin(file)) for file in files)
    return f"{twin.stem}_{(sha256(digests.encode()).hexdigest() if files != [twin] else digests)[:6]}"


def mended(robot: Path, out: Path, workers: int) -> Path:
    """The twin that commands make, in ``workers`` processes, of sweeps and presses of the surrogate ``robot``, if it is not yet
    below ``out``. It starts from the nominal one, and nothing of ``robot`` but the recordings is read."""
    folder = out / "surrogates" / named(robot)
    done, twin = folder / f"mended_{robot.stem}.yaml", folder / "sweeps" / TWIN
    if done.exists():
        return done
    folder.mkdir(parents=True, exist_ok=True)
    for pads in ("no", "left", "right"):
        name = "sweeps" if pads == "no" else f"{pads}_presses"
        recorded, found = folder / name, folder / f"{name}_diagnosis"
        if not recorded.exists():
            design = "chirp" if pads == "no" else "pack"  # presses have none
            step(
                surrogate.run,
                SurrogateConfig(
                    secret=0, twin=robot, pads=pads, design=design, out=recorded
                ),
            )
        if not (found / TWIN).exists():
            data = recorded / (SWEEPS if pads == "no" else PRESSES)
            asked = DiagnoseConfig(
                measurements=data, twin=twin, until="noise_floor", out=found
            )
            asked = dataclasses.replace(
                asked, workers=workers, accept=["lost_samples"]
            )  # as drivers lose some
            step(
                diagnose.run, asked, (0, 1)
            )  # 1: something is left that no effect explains
        twin = found / TWIN
    shutil.copy(twin, done.with_suffix(".unfinished"))
    return done.with_suffix(".unfinished").rename(done)
