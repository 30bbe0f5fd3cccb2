"""LeRobot's teleoperators as leader arms of the twin: ``taccorl collect --source.type=leader --source.teleop=NAME``.

LeRobot gives a dict of named numbers without units. Names and units must match those of the twin or be given as options: nothing
is guessed, because an arm that takes degrees for radians hits the table.
"""

import importlib
import json
import math
import pkgutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import draccus
import lerobot.teleoperators
import numpy as np
import yaml
from lerobot.teleoperators import (
    Teleoperator,
    TeleoperatorConfig,
    make_teleoperator_from_config,
)
from lerobot.utils.import_utils import register_third_party_plugins

from taccorl.data.spec import find_spec, load_dataset_spec
from taccorl.episodes.sources.teleop import LeaderSource
from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT

JOINT_UNITS = ("rad", "deg", "range_m100_100")
"""Units that a teleoperator's joints may have, see ``to_twin``."""
GRIPPER_UNITS = ("m", "range_0_100")
"""Units that a teleoperator's grippers may have, see ``to_twin``."""
_FAR_RAD, _FAR_M = (
    0.35,
    0.02,
)  # a first reading this far beyond a limit is another unit, not another arm's range
_GRIPPERS = np.array(ROBOT.gripper_indices)


class LeRobotLeader:
    """A LeRobot teleoperator with a value for every joint and gripper of the twin.

    Raises:
        TaccorlError: its values differ from those that ``source`` states, or units are not stated.
    """

    def __init__(self, device: Teleoperator, source: LeaderSource) -> None:
        self._device, self._source = device, source
        _check_units(source)
        self.names = match_names(_given(device), source.names, source.teleop)
        """The teleoperator's names, in the order of the twin's actions."""
        self._checked = False

    def connect(self) -> None:
        """May ask for a calibration on the terminal, as LeRobot does.

        Raises:
            TaccorlError: the device does not answer.
        """
        try:
            self._device.connect()
        except (OSError, RuntimeError, ImportError) as error:
            what = f"{type(error).__name__}: {error}"
            raise TaccorlError(
                f"{self._source.teleop}: cannot connect: {what}. Is the port in --source.options right?"
            ) from error

    def read(self) -> np.ndarray:
        """(A,) joint angles [rad] and gripper openings [m] now.

        Raises:
            TaccorlError: a value is missing or not a number, or the first reading shows that the unit is wrong.
        """
        action = self._device.get_action()
        try:
            given = np.array([float(action[name]) for name in self.names])
        except (KeyError, TypeError, ValueError) as error:
            raise TaccorlError(
                f"{self._source.teleop}: an action without {error}; the device announced {', '.join(self.names)}"
            ) from error
        values = to_twin(given, self._source.joint_unit, self._source.gripper_unit)
        if not np.isfinite(values).all():
            k = int(np.flatnonzero(~np.isfinite(values))[0])
            raise TaccorlError(f"{self._source.teleop}: {self.names[k]} is {given[k]}")
        if not self._checked:
            self._check_first(given, values)
            self._checked = True
        return values

    def close(self) -> None:
        """Disconnect."""
        if self._device.is_connected:
            self._device.disconnect()

    def _check_first(self, given: np.ndarray, values: np.ndarray) -> None:
        far = np.where(np.isin(np.arange(len(values)), _GRIPPERS), _FAR_M, _FAR_RAD)
        off = (values < ROBOT.action_low - far) | (values > ROBOT.action_high + far)
        if off.any():
            k = int(np.flatnonzero(off)[0])
            what, unit, known = (
                ("gripper", "m", GRIPPER_UNITS)
                if k in _GRIPPERS
                else ("joint", "rad", JOINT_UNITS)
            )
            said = getattr(self._source, f"{what}_unit")
            raise TaccorlError(
                f"{self._source.teleop}: {self.names[k]} reads {given[k]:g} {said}, far beyond {ROBOT.action_low[k]:.3g} … "
                f"{ROBOT.action_high[k]:.3g} {unit}: is it in another unit? --source.{what}_unit={'|'.join(known)}"
            )


def open_leader(source: LeaderSource) -> LeRobotLeader:
    """Open and connect the teleoperator that ``source`` names.

    Raises:
        TaccorlError: its name is unknown, options are wrong, its values do not match the twin's, or it does not answer.
    """
    config = teleoperator_config(source.teleop, source.options)
    try:
        device = make_teleoperator_from_config(config)
    except (ImportError, ValueError, OSError) as error:
        raise TaccorlError(
            f"{source.teleop}: LeRobot cannot make it: {error}"
        ) from error
    leader = LeRobotLeader(device, source)
    leader.connect()
    return leader


def teleoperator_config(name: str, options: str = "") -> TeleoperatorConfig:
    """LeRobot's config of that name with the options of a YAML or JSON file. Raises TaccorlError: the name is unknown (the
    message gives the nearest), or options are unreadable or wrong."""
    missing = _register_all()
    choices = TeleoperatorConfig.get_known_choices()
    if name not in choices:
        without = (
            f" (without {', '.join(missing)}, which miss a package)" if missing else ""
        )
        raise TaccorlError(
            f"--source.teleop={name}: LeRobot has no teleoperator of that name; {nearest(name, choices)}{without}"
        )
    try:
        given = (
            yaml.safe_load(Path(options).expanduser().read_text(encoding="utf-8"))
            if options
            else {}
        )
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise TaccorlError(
            f"--source.options={options}: cannot be read: {' '.join(str(error).split())}"
        ) from error
    try:
        return draccus.decode(choices[name], given or {})
    except Exception as error:  # draccus has an own kind for each way to be wrong, and a config's own checks more
        said = " ".join(str(error).split())
        raise TaccorlError(
            f"{name}: --source.options={options}: {json.dumps(given)} does not fit: {said}"
        ) from error


def _register_all() -> list[str]:
    """LeRobot knows a teleoperator once its module is imported; names those that cannot be."""
    missing = []
    for module in pkgutil.iter_modules(lerobot.teleoperators.__path__):
        if module.ispkg:
            try:
                importlib.import_module(f"lerobot.teleoperators.{module.name}")
            except ImportError:
                missing.append(module.name)
    register_third_party_plugins()
    return missing


def _given(device: Teleoperator) -> list[str]:
    features: Mapping[str, Any] = device.action_features
    return list(features["names"]) if "names" in features else list(features)


def match_names(
    given: Sequence[str], renamed: Mapping[str, str | None], teleop: str
) -> list[str]:
    """Return the device's names in the order of the twin's actions.

    Args:
        given: names of the values that the device sends, in its order.
        renamed: the device's name → the twin's, or None for one that is not used.

    Raises:
        TaccorlError: names are missing, superfluous, unknown or repeated; the message lists them.
    """
    wanted = load_dataset_spec(find_spec("taccorl_bimanual")).features["action"].names
    assert wanted is not None, "the data spec names the action's values"
    for theirs, ours in renamed.items():
        if theirs not in given:
            raise TaccorlError(
                f"--source.names: {teleop} has no value {theirs!r}; {nearest(theirs, given)}"
            )
        if ours is not None and ours not in wanted:
            raise TaccorlError(
                f"--source.names: {theirs}: the twin has no {ours!r}; {nearest(ours, wanted)}"
            )
    ours = {
        theirs: renamed.get(theirs, theirs)
        for theirs in given
        if renamed.get(theirs, theirs) is not None
    }
    missing = [name for name in wanted if name not in ours.values()]
    surplus = [theirs for theirs, name in ours.items() if name not in wanted]
    doubled = [
        theirs for theirs, name in ours.items() if list(ours.values()).count(name) > 1
    ]
    if missing or surplus or doubled:
        faults = [
            ("missing", missing),
            ("left over", surplus),
            ("for the same value", doubled),
        ]
        said = "; ".join(
            f"{what}: {', '.join(names)}" for what, names in faults if names
        )
        raise TaccorlError(
            f"{teleop} has {len(given)} values, but the twin has {len(wanted)}. {said[0].upper()}{said[1:]}. State which is "
            "which: --source.names='{their_name: left_joint_1.pos, not_used: null, …}'"
        )
    return [
        next(theirs for theirs, name in ours.items() if name == target)
        for target in wanted
    ]


def _check_units(source: LeaderSource) -> None:
    for what, known in (("joint", JOINT_UNITS), ("gripper", GRIPPER_UNITS)):
        unit = getattr(source, f"{what}_unit")
        if unit not in known:
            said = f"{unit!r} is none of them" if unit else "it has to be said"
            raise TaccorlError(
                f"--source.{what}_unit={'|'.join(known)}: {said}. LeRobot's own arms give joints in deg or, with "
                "use_degrees=false, in range_m100_100, and grippers in range_0_100; check which of them your arm sends."
            )


def to_twin(values: np.ndarray, joint_unit: str, gripper_unit: str) -> np.ndarray:
    """Convert ``values`` (A,), in the order of the twin's actions, from a leader's units to rad and m; returns (A,).

    rad, m: as they are. deg: π / 180. range_m100_100: −100 is our joint's lower limit, 100 its upper. range_0_100: 0 is closed,
    100 is 70 mm open.
    """
    low, high = (
        np.delete(ROBOT.action_low, _GRIPPERS),
        np.delete(ROBOT.action_high, _GRIPPERS),
    )
    joints, grippers = np.delete(values, _GRIPPERS), values[_GRIPPERS]
    if joint_unit == "deg":
        joints = joints * math.pi / 180
    elif joint_unit == "range_m100_100":
        joints = low + (joints + 100) / 200 * (high - low)
    if gripper_unit == "range_0_100":
        grippers = grippers / 100 * ROBOT.opening_max_m
    return np.insert(joints, _GRIPPERS - np.arange(len(_GRIPPERS)), grippers)
