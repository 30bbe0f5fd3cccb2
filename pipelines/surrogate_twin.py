"""A surrogate of the robot for co-training: the twin with effects that the user's twin lacks, other cameras and another gain; and
the twin that commands mend of recordings of a surrogate.

It is simulated, and data collected in it is labelled so (``ORIGIN``). The surrogate of ``taccorl surrogate``, for finding
missing effects, has its own physics and no scenes for demonstrations.
"""

import dataclasses
import shutil
from hashlib import sha256
from pathlib import Path

import numpy as np

from pipelines.steps import step
from taccorl.cli import diagnose, surrogate
from taccorl.cli.diagnose import DiagnoseConfig
from taccorl.cli.surrogate import SurrogateConfig
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects import make_effect
from taccorl.sim.effects.effect import Effect
from taccorl.sim.sensors.flexitac import FlexiTacConfig
from taccorl.sim.twin import TwinConfig
from taccorl.sim.twin_file import load_twin, twin_digest
from taccorl.surrogate.writing import PRESSES, SWEEPS, TWIN

ORIGIN = "twin with hidden effects and other cameras, not a robot"
"""Text of the origin of every dataset."""
FRICTION_NM = (0.1, 0.5)
"""Range of the dry friction of each joint [N·m]."""
GRAVITY_SHARE = (0.85, 1.1)
"""Range of the factor on the share of the weight that the controller compensates."""
DELAY_S = (0.005, 0.02)
"""Range of the delay of commands [s]."""
GAIN_LOG_STD = (0.1, 0.2)
"""Range of the standard deviation of the logarithms of the taxels' gains."""
GAIN_RATIO = (0.85, 1.15)
"""Range of the factor on the nominal pads' counts per reading of 1."""
CAMERA_TURN_RAD, CAMERA_SHIFT_M = 0.02, 0.01
"""Standard deviations of camera rotations about, and of translations along, each axis [rad, m]: those of a bracket mounted by
hand."""


def draw_surrogate_twin(secret: int) -> TwinConfig:
    """Draw a surrogate robot: each ``secret`` gives another one. Ranges are choices around the effects' typical values.

    Raises:
        TaccorlError: the secret is negative.
    """
    if secret < 0:
        raise TaccorlError(f"secret {secret}: seeds are 0, 1, 2, …")
    rng, nominal = np.random.default_rng([secret, 0x5A11]), TwinConfig()
    hidden: list[Effect] = []
    for arm in ROBOT.arms:
        hidden += [
            make_effect("coulomb_friction", arm=arm, torque_nm=rng.uniform(*FRICTION_NM)),
            make_effect("gravity_mismatch", arm=arm, share=rng.uniform(*GRAVITY_SHARE)),
            make_effect("command_delay", arm=arm, delay_s=rng.uniform(*DELAY_S)),
        ]
    hidden.append(make_effect("taxel_gain_spread", log_std=rng.uniform(*GAIN_LOG_STD), seed=secret))
    for camera in nominal.cameras:
        turn, shift = rng.normal(0, CAMERA_TURN_RAD, 3), rng.normal(0, CAMERA_SHIFT_M, 3)
        values = {f"turn_{axis}_rad": float(x) for axis, x in zip("xyz", turn, strict=True)}
        values |= {f"shift_{axis}_m": float(x) for axis, x in zip("xyz", shift, strict=True)}
        hidden.append(make_effect("camera_pose", cameras=[camera.name], **values))
    for effect in hidden:
        effect.evidence = f"surrogate: {ORIGIN}; secret {secret}"
    assert isinstance(nominal.sensor, FlexiTacConfig), "the nominal twin's pads"
    gain_count = nominal.sensor.gain_count * rng.uniform(*GAIN_RATIO)
    return dataclasses.replace(
        nominal, effects=hidden, sensor=dataclasses.replace(nominal.sensor, gain_count=gain_count)
    )


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
            step(surrogate.run, SurrogateConfig(secret=0, twin=robot, pads=pads, design=design, out=recorded))
        if not (found / TWIN).exists():
            data = recorded / (SWEEPS if pads == "no" else PRESSES)
            asked = DiagnoseConfig(measurements=data, twin=twin, until="noise_floor", out=found)
            asked = dataclasses.replace(asked, workers=workers, accept=["lost_samples"])  # as drivers lose some
            step(diagnose.run, asked, (0, 1))  # 1: something is left that no effect explains
        twin = found / TWIN
    shutil.copy(twin, done.with_suffix(".unfinished"))
    return done.with_suffix(".unfinished").rename(done)
