"""Recordings made of arrays: of one signal, of one joint, and of cells that a load presses."""

from typing import Any

import numpy as np

from taccorl.alignment.controller.joint_motion import JointMotion
from taccorl.alignment.machines.cell_tables import CellMeasurement
from taccorl.alignment.measurements.measurement import Measurement


def of_signal(
    name: str,
    rate_hz: float,
    target: np.ndarray,
    measured: np.ndarray,
    signal: str,
    unit: str = "rad",
    **more: Any,
) -> Measurement:
    """Targets and measured positions (T,) at ``rate_hz``; arrays in ``more`` are (T,), too."""
    columns = {"target": target, "measured": measured} | {
        k: v for k, v in more.items() if isinstance(v, np.ndarray)
    }
    fields: dict[str, Any] = more | {
        key: values[:, None] for key, values in columns.items()
    }
    return Measurement(
        name=name,
        time_s=np.arange(len(target)) / rate_hz,
        signals=(signal,),
        units=(unit,),
        **fields,
    )


def of_joint(
    name: str,
    rate_hz: float,
    target: np.ndarray,
    measured: np.ndarray,
    effort: np.ndarray | float = np.nan,
    start: float = 0.0,
) -> JointMotion:
    """Targets, measured positions and efforts (T,) of a joint that no other one loads, from rest at ``start``."""
    rows = {
        "target": target,
        "measured": measured,
        "effort": effort + np.zeros(len(target)),
    }
    time_s, still = np.arange(len(target)) / rate_hz, np.zeros(len(target))
    return JointMotion(
        name=name,
        time_s=time_s,
        rate_hz=rate_hz,
        coupling_nm=still,
        start=start,
        **rows,
    )


def play(values: np.ndarray, half_width: float, start: float = 0.0) -> np.ndarray:
    """(T,) what stands still until ``values`` (T,) are ``half_width`` away, and is then taken along."""
    at, found = start, np.empty(len(values))
    for k, value in enumerate(values.tolist()):
        at = found[k] = min(max(at, value - half_width), value + half_width)
    return found


def of_cells(
    name: str,
    rate_hz: float,
    load: np.ndarray,
    readings: np.ndarray,
    names: tuple[str, ...] = ("thumb",),
    **more: Any,
) -> CellMeasurement:
    """Readings (T, K) [count] of cells that all bear a load (T,) at ``rate_hz``, in steps of 1."""
    numbers = {
        "measured": readings,
        "target": np.repeat(load[:, None], len(names), axis=1),
        "quantum": np.ones(len(names)),
    }
    time_s, units = np.arange(len(load)) / rate_hz, ("count",) * len(names)
    return CellMeasurement(
        name=name, time_s=time_s, signals=names, units=units, **numbers, **more
    )
