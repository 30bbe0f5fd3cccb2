"""Read and write ``twin.yaml``: a twin as differences from the nominal one, with the effects found in the robot.

::

    robot: {inertias: menagerie}                 # sections as in TwinConfig; what is not here is as in its dataclass
    controller: {kp_nm_per_rad: [1813, 1392.4, 974.8, 587.1, 151.1, 151.8]}
    cameras:                                     # by name: differences from the nominal one; null takes it away
      front: {offset: {rotation_rad: [0.01, 0, 0]}}
    sensor: {gain_count: 80}                     # type: another kind of sensor
    effects:
    - effect: coulomb_friction                   # registered name, its parameters, and where it acts
      torque_nm: 0.41
      arm: left
      joints: [joint5]
      interval: {torque_nm: [0.38, 0.44]}        # 95 %
      evidence: validation error of sweep_07 falls from 2.01 to 0.20 mrad
"""

import dataclasses
import hashlib
import math
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_origin

import numpy as np
import yaml

from taccorl.data.strict_yaml import MOST_BYTES, Document, composed, read_bounded
from taccorl.errors import SpecError, TaccorlError, nearest
from taccorl.plugins import Registry
from taccorl.sim.cameras import CameraConfig
from taccorl.sim.effects import effects
from taccorl.sim.effects.added import present
from taccorl.sim.effects.effect import Effect
from taccorl.sim.sensors import SensorConfig, sensors
from taccorl.sim.twin import TwinConfig

_HEADER = """\
# A twin: what differs from the nominal one. taccorl/sim/twin_file.py says what may stand here.
"""


def load_twin(path: Path) -> TwinConfig:
    """Load a twin.yaml. A file of comments is the nominal twin; one without a byte is not, because a full disk leaves such
    files. Raises SpecError: the file cannot be read, or holds a key, value or effect that does not exist; with file and
    line."""
    path = Path(path)
    if path.is_file() and path.stat().st_size == 0:
        way = "write the `kind:` of your machine; of the PiPER's nominal twin it holds a comment, # nominal"
        raise SpecError(f"{path}: is empty (0 bytes); {way}")
    if _says_nothing(path):
        return TwinConfig()
    kind, line = kind_of(path)
    if kind is not None:
        raise SpecError(
            f"{path}:{line}: is of kind {kind!r}, for compare and diagnose; give a twin.yaml of the PiPER"
        )
    document = EffectsDocument(TwinConfig, path)
    try:
        present(document.value.effects)
    except TaccorlError as error:
        raise document.error("effects", str(error)) from error
    return document.value


def _says_nothing(path: Path) -> bool:
    try:
        lines = read_bounded(path, MOST_BYTES, "a twin").splitlines()
    except SpecError:
        return False  # what reads it says so
    return all(not line.strip() or line.lstrip().startswith("#") for line in lines)


def kind_of(path: Path) -> tuple[str | None, int]:
    """Return value and line number (from 1) of the key ``kind``, which files of machines other than the PiPER begin with.

    (None, 1) if the key is missing, or if the file cannot be read or is not YAML: the function that loads it raises the error."""
    try:
        root = composed(read_bounded(path, MOST_BYTES, "a twin"))
    except (SpecError, yaml.YAMLError, RecursionError):
        return None, 1
    for key, value in root.value if isinstance(root, yaml.MappingNode) else ():
        if key.value == "kind":
            return str(value.value), key.start_mark.line + 1
    return None, 1


def twin_text(config: TwinConfig) -> str:
    """Return the content of a ``twin.yaml`` for ``config``: its differences from the nominal twin. Raises TaccorlError: a
    number is not finite."""
    nominal = TwinConfig()
    content = _differences(config, nominal, skip=("cameras", "sensor", "effects"))
    if config.cameras != nominal.cameras:
        content["cameras"] = _camera_differences(config.cameras, nominal.cameras)
    if config.sensor != nominal.sensor:
        content["sensor"] = _plugin_differences(
            "type", sensors, config.sensor, type(nominal.sensor)
        )
    content["effects"] = [effect_entry(effect) for effect in config.effects]
    return _HEADER + yaml.safe_dump(
        content, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120
    )


def twin_digest(config: TwinConfig) -> str:
    """Digest of a twin, 16 hexadecimal digits; equal twins have equal digests."""
    return hashlib.sha256(twin_text(config).encode()).hexdigest()[:16]


def save_twin(config: TwinConfig, path: Path) -> None:
    """Write ``twin_text``; the file is replaced as a whole or not at all. Raises TaccorlError: the folder cannot be written to,
    a number is not finite, or two of its effects exclude each other, so that ``load_twin`` would refuse the file."""
    present(config.effects)
    write_whole(path, twin_text(config))


def effect_entry(effect: Effect) -> dict[str, Any]:
    """Return an effect as an entry of a file's ``effects``: ``effect``, its name, and the parameters that differ from its class's
    defaults."""
    registered = effects.get(effect.name)
    if not isinstance(effect, registered):
        return _plugin_differences("effect", effects, effect)
    return {"effect": effect.name} | _differences(effect, type(effect)())


def write_whole(path: Path, text: str) -> None:
    """Write a text file; it is replaced as a whole or not at all. Raises TaccorlError: the folder cannot be written to."""
    path = Path(path)
    new = path.with_name(f".{path.name}.new")
    try:
        new.write_text(text, encoding="utf-8")
        new.replace(path)
    except OSError as error:
        new.unlink(missing_ok=True)
        raise TaccorlError(f"{path}: cannot be written: {error}") from error


class EffectsDocument[T](Document[T]):
    """Strictly read YAML file with effects: ``Document`` extended by lists of effects, plug-ins and cameras."""

    def _build(self, kind: Any, node: yaml.Node, key: str) -> Any:
        self._lines.setdefault(key, node.start_mark.line + 1)
        if kind is Effect:
            return self._plugin("effect", effects, None, node, key)
        if kind is SensorConfig:
            return self._plugin("type", sensors, type(TwinConfig().sensor), node, key)
        if kind == list[CameraConfig]:
            return self._cameras(node, key)
        if get_origin(kind) is list:
            return list(self._tuple((get_args(kind)[0], ...), node, key))
        return super()._build(kind, node, key)

    def _dataclass(self, cls: Any, node: yaml.Node, key: str) -> Any:
        values = self._values(cls, self._items(node, key), key)
        missing = [
            f.name
            for f in dataclasses.fields(cls)
            if _is_required(f) and f.name not in values
        ]
        if missing:
            raise self.error(key, f"key {missing[0]!r} is missing")
        return self._made(cls, values, key)

    def _values(
        self, cls: type, items: list[tuple[str, yaml.Node]], key: str
    ) -> dict[str, Any]:
        """Fields of ``cls`` that stand in the file."""
        hints, known = (
            typing.get_type_hints(cls),
            [f.name for f in dataclasses.fields(cls)],
        )
        values = {}
        for name, child in items:
            path = f"{key}/{name}" if key else name
            if name not in known:
                other = (
                    "; the file of a robot, axis or cells begins with its kind: `kind: robot`"
                    * (cls is TwinConfig)
                )
                raise self.error(
                    path, f"unknown key {name!r}; {nearest(name, known)}{other}"
                )
            values[name] = self._build(hints[name], child, path)
        return values

    def _made(self, make: Any, values: dict[str, Any], key: str) -> Any:
        """``make(**values)``; what it finds wrong is said with the line of the first value that it names."""
        try:
            return make(**values)
        except SpecError:
            raise
        except TaccorlError as error:
            text = str(error)
            named = sorted((text.index(name), name) for name in values if name in text)
            place = f"{key}/{named[0][1]}".lstrip("/") if named else key
            raise self.error(
                place, text.removeprefix(f"{place.rsplit('/', 1)[-1]}: ")
            ) from error

    def _plugin(
        self,
        tag: str,
        registry: Registry[Any],
        default: type | None,
        node: yaml.Node,
        key: str,
    ) -> Any:
        """A plug-in named by the key ``tag``, with its settings."""
        items = dict(self._items(node, key))
        if tag not in items and default is None:
            raise self.error(
                key,
                f"key {tag!r} is missing; its value is one of: {', '.join(registry)}",
            )
        cls: Any = default
        if tag in items:
            name = self._scalar(str, items.pop(tag), f"{key}/{tag}")
            if name not in registry:
                raise self.error(
                    f"{key}/{tag}",
                    f"no {registry.kind} {name!r}; {nearest(name, registry)}",
                )
            cls = registry.get(name)
        return self._made(cls, self._values(cls, list(items.items()), key), key)

    def _cameras(self, node: yaml.Node, key: str) -> list[CameraConfig]:
        cameras = {camera.name: camera for camera in TwinConfig().cameras}
        for name, child in self._items(node, key):
            path = f"{key}/{name}"
            if isinstance(child, yaml.ScalarNode) and child.tag.endswith(":null"):
                if cameras.pop(name, None) is None:
                    raise self.error(
                        path,
                        f"there is no camera {name!r} to remove; {nearest(name, cameras)}",
                    )
                continue
            values = self._values(CameraConfig, self._items(child, path), path)
            if values.get("name", name) != name:
                raise self.error(
                    f"{path}/name",
                    f"the camera's name is its key, {name!r}; remove this key",
                )
            nominal = cameras.get(name)
            old = (
                {
                    f.name: getattr(nominal, f.name)
                    for f in dataclasses.fields(CameraConfig)
                }
                if nominal
                else {}
            )
            cameras[name] = self._made(
                CameraConfig, old | values | {"name": name}, path
            )
        return list(cameras.values())


def _is_required(field: dataclasses.Field) -> bool:
    return (
        field.default is dataclasses.MISSING
        and field.default_factory is dataclasses.MISSING
    )


def _differences(value: Any, base: Any, skip: tuple[str, ...] = ()) -> dict[str, Any]:
    """Fields of a dataclass that are not as in ``base``, of the same class, in a form that YAML knows."""
    found: dict[str, Any] = {}
    for name in (f.name for f in dataclasses.fields(value) if f.name not in skip):
        mine, other = getattr(value, name), getattr(base, name)
        if mine == other:
            continue
        nested = dataclasses.is_dataclass(mine) and type(mine) is type(other)
        found[name] = _differences(mine, other) if nested else _plain(mine, name)
    return found


def _plugin_differences(
    tag: str, registry: Registry[Any], value: Any, default: type | None = None
) -> dict[str, Any]:
    """``{tag: name, …}`` with what is not as in the plug-in's class; without the tag for ``default``."""
    cls = type(value)
    if cls is default:
        return _differences(value, cls())
    names = [name for name in registry if registry.get(name) is cls]
    if not names:
        raise TaccorlError(
            f"{cls.__name__} is not a registered {registry.kind}, so that a file cannot name it"
        )
    return {tag: names[0]} | _differences(value, cls())


def _camera_differences(
    cameras: list[CameraConfig], nominal: list[CameraConfig]
) -> dict[str, Any]:
    bases = {camera.name: camera for camera in nominal}
    mine = {camera.name: camera for camera in cameras}
    order = [
        *(name for name in bases if name in mine),
        *(name for name in mine if name not in bases),
    ]
    if list(mine) != order or len(mine) < len(cameras):
        raise TaccorlError(
            f"cameras {[c.name for c in cameras]}: a file has each camera once, {list(bases)} first"
        )
    found: dict[str, Any] = {name: None for name in bases if name not in mine}
    for name, camera in mine.items():
        if name not in bases:
            found[name] = {k: v for k, v in _plain(camera, name).items() if k != "name"}
        elif camera != bases[name]:
            found[name] = _differences(camera, bases[name])
    return found


def _plain(value: Any, name: str) -> Any:
    """Numbers, texts, lists and mappings of them."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        raise TaccorlError(f"{name} is {value}: a twin file holds finite numbers")
    if dataclasses.is_dataclass(value):
        return dict(_plain_fields(value))
    if isinstance(value, dict):
        return {key: _plain(item, f"{name} → {key}") for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(item, name) for item in value]
    return value


def _plain_fields(value: Any) -> Iterator[tuple[str, Any]]:
    for field in dataclasses.fields(value):
        mine = getattr(value, field.name)
        if (
            _is_required(field)
            or field.default is dataclasses.MISSING
            or mine != field.default
        ):
            yield field.name, _plain(mine, field.name)
