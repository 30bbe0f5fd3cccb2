"""Measurements simulated by the twin itself with effects that are known here. Not a robot: every one says so."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.data.origin import Origin
from taccorl.robots import ROBOT
from taccorl.sim.bench import Bench
from taccorl.sim.effects import make_effect
from taccorl.sim.replay import replay
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import TwinConfig

RATE_HZ = 200.0
NOISE_RAD = 2e-4
ORIGIN = Origin(
    "twin", "simulated by the twin with effects known to the test, not a robot"
)
SIGNAL = "left_joint5"


def friction(torque_nm: float = 1.0) -> TwinConfig:
    """The twin with dry friction in left_joint5."""
    return TwinConfig(
        effects=[
            make_effect(
                "coulomb_friction", torque_nm=torque_nm, arm="left", joints=["joint5"]
            )
        ]
    )


def chirp(
    seed: int, seconds: float = 6.0, signals: tuple[str, ...] = (SIGNAL,)
) -> np.ndarray:
    """(T, 14) commands: a second of rest, a chirp of up to 1.5 Hz of ``signals``, half a second of rest."""
    rng, sim = np.random.default_rng(seed), Simulation(Bench())
    sim.reset([0])
    time_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    angle = 2 * np.pi * (0.2 * time_s + 1.3 * time_s**2 / (2 * seconds))
    fade = np.clip(np.minimum(time_s, seconds - time_s) / 0.5, 0, 1) ** 2
    target = np.tile(sim.targets[0], (len(time_s) + 300, 1))
    for signal in signals:
        wave = rng.uniform(0.15, 0.3) * np.sin(angle + rng.uniform(0, 0.5)) * fade
        target[200 : 200 + len(time_s), ROBOT.action_names.index(signal)] += wave
    return target


def recorded(
    config: TwinConfig, target: np.ndarray, seed: int, **fields: Any
) -> Measurement:
    """What a driver would have logged of the twin: positions with noise, efforts with noise."""
    sim = Simulation(Bench(), config)
    sim.reset([0])
    start = sim.proprioception()[0].copy()
    rest = 200  # rows in which effects sag the arm to where it rests; the recording begins after them
    done = replay(
        sim, np.concatenate([np.tile(target[:1], (rest, 1)), target]), RATE_HZ, start
    )
    rng = np.random.default_rng(1000 + seed)
    reported, effort = done.reported[rest:], done.effort[rest - 1 : -1]
    rows = {"time_s": np.arange(len(target)) / RATE_HZ, "target": target}
    rows["measured"] = reported + NOISE_RAD * rng.normal(size=reported.shape)
    rows["effort"] = effort + 0.05 * rng.normal(size=effort.shape)
    return Measurement(**{"name": f"sweep_{seed}", "origin": ORIGIN} | rows | fields)


def sweeps(
    config: TwinConfig, signals: tuple[str, ...] = (SIGNAL,), seconds: float = 6.0
) -> Measurements:
    """Two sweeps to fit, the first recorded twice, and one for validation."""
    first = recorded(config, chirp(0, seconds, signals), 0)
    again = dataclasses.replace(
        recorded(config, first.target, 7), name="sweep_0_again", repeat_of=first.name
    )
    second = recorded(config, chirp(1, seconds, signals), 1)
    return Measurements(
        (first, again, second),
        (recorded(config, chirp(2, seconds, signals), 2),),
        rule="by hand",
    )


def write_folder(
    folder: Path, measurements: Measurements, signals: tuple[str, ...] = (SIGNAL,)
) -> Path:
    """As tables with a ``measurements.yaml`` that says which is for validation and which repeats another."""
    folder.mkdir(parents=True, exist_ok=True)
    index: dict[str, Any] = {"recordings": {}}
    for use in ("fit", "validation", "test"):
        for m in getattr(measurements, use):
            note = {"use": use} | (
                {"repeat_of": f"{m.repeat_of}.csv"} if m.repeat_of else {}
            )
            index["recordings"][f"{m.name}.csv"] = note
            columns = {"t": m.time_s}
            for signal in signals:
                j = m.column(signal)
                columns |= {
                    f"{signal}.q_target": m.target[:, j],
                    f"{signal}.q": m.measured[:, j],
                }
                columns |= {f"{signal}.tau": m.effort[:, j]}
            text = [
                ",".join(columns),
                *(
                    ",".join(f"{x:.9g}" for x in row)
                    for row in zip(*columns.values(), strict=True)
                ),
            ]
            (folder / f"{m.name}.csv").write_text("\n".join(text) + "\n")
    (folder / "measurements.yaml").write_text(yaml.safe_dump(index))
    return folder
