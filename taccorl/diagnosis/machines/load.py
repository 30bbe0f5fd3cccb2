"""Load the machine that a file describes, whatever its kind."""

from pathlib import Path

from taccorl.diagnosis.machines.machine import Machine, machines
from taccorl.diagnosis.machines.piper import PiperTwin
from taccorl.errors import SpecError, nearest
from taccorl.sim.twin_file import kind_of


def load_machine(path: Path | None) -> Machine:
    """Load the machine that a file describes; without a file, the nominal twin of the PiPER.

    Raises:
        SpecError: the file cannot be read, its kind is unknown, or it does not fit that kind; the message names file and line.
    """
    if path is None:
        return PiperTwin.nominal()
    if path.is_file() and path.suffix.lower() in (".xml", ".mjcf", ".urdf"):
        raise SpecError(
            f"{path}: is a model, where a robot file is needed; `taccorl init-robot {path}` drafts one"
        )
    kind, line = kind_of(path)
    if kind is None:
        return PiperTwin.load(path)
    if kind not in machines:
        raise SpecError(
            f"{path}:{line}: kind: there is no kind of machine {kind!r}; {nearest(kind, machines)}"
        )
    return machines.get(kind).load(path)
