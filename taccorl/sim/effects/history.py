"""MuJoCo's buffers of past controls and sensor values, which delays read from."""

import math

import mujoco
import numpy as np
from mujoco.batch import Batch

_LINEAR = 1  # MuJoCo's ``interp``: with the default, a hold, the trajectory would change with the delay in jumps


def delay(
    entry: mujoco.MjsActuator | mujoco.MjsSensor, delay_s: float, timestep_s: float
) -> None:
    """Delay the control of an actuator, or the value of a sensor, by ``delay_s``, with linear interpolation.

    Values are stored once a physics step (``timestep_s``), and read before the newest is stored: a delay below one step acts as
    one step."""
    entry.nsample = math.ceil(delay_s / timestep_s) + 1
    entry.delay, entry.interp = delay_s, _LINEAR


def fill_histories(batch: Batch, ids: np.ndarray) -> None:
    """After a reset of the simulations ``ids`` (n,), fill the buffers of delayed controls and sensors with their present values.
    MuJoCo's buffers begin with zeros."""
    if not batch.model.nhistory:
        return
    model = batch.get_model(0)
    data = mujoco.MjData(model)
    for i in ids:
        batch.get_model(int(i), model)
        batch.get_data(int(i), data)
        model.sensor_delay[:] = 0  # what the sensors say now
        mujoco.mj_forward(model, data)
        for k, (num, _) in enumerate(model.actuator_history):
            if num:
                first, size = model.actuator_ctrladr[k], model.actuator_ctrlnum[k]
                values = np.tile(data.ctrl[first : first + size], (num, 1))
                mujoco.mj_initCtrlHistory(model, data, k, None, values)
        for k, (num, _) in enumerate(model.sensor_history):
            if num:
                first, size = model.sensor_adr[k], model.sensor_dim[k]
                values = np.tile(data.sensordata[first : first + size], (num, 1))
                mujoco.mj_initSensorHistory(model, data, k, None, values, 0.0)
        batch.bind("history")[i] = data.history
