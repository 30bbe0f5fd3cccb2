"""Descriptions of the registered effects as text, for ``taccorl effects``."""

from collections.abc import Sequence

from taccorl.errors import TaccorlError, nearest
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import KINDS, NEEDS, Effect, Parameter
from taccorl.sim.effects.prose import ALWAYS_FITTED


def names_for(kind: str = "") -> list[str]:
    """Return the names of the effects that act on ``kind`` (a word of ``KINDS``); of all effects for an empty one. Raises
    TaccorlError: no such kind; the message names the nearest."""
    if kind and kind not in KINDS:
        raise TaccorlError(
            f"--for={kind}: no effect acts on that; {nearest(kind, KINDS)}"
        )
    return [name for name in effects if not kind or kind in effects.get(name).kinds()]


def brief(cls: type[Effect]) -> list[str]:
    """Return lines of plain text about an effect: the parts it acts on, equation, parameters with units, required knowledge,
    recordings that show it, near-twins."""
    lines = [f"{cls.name}  ({', '.join(cls.kinds())})  {cls.equation}"]
    lines += [f"    {parameter_words(p)}" for p in cls.parameters()]
    lines += [f"    needs: {', '.join(cls.needs)}", f"    record: {cls.to_record}"]
    twins = [ALWAYS_FITTED.get(name, name) for name in cls.near_twins]
    return [*lines, *([f"    near-twins: {', '.join(twins)}"] if twins else [])]


def full(cls: type[Effect]) -> list[str]:
    """Return the lines of ``brief``, followed by a description in words, the sources of typical values and the recordings that
    separate the effect from each near-twin."""
    head, *rest = brief(cls)
    rest = [line for line in rest if not line.startswith("    near-twins: ")]
    rest = [
        line
        if not line.startswith("    needs: ")
        else f"    needs: {needs_words(cls.needs)}"
        for line in rest
    ]
    lines = [
        head,
        f"    {cls.in_words}",
        *rest,
        f"    what it does to a policy: {cls.at_a_policy}",
    ]
    lines += [f"    source of {p.name}: {p.source}" for p in cls.parameters()]
    return [
        *lines,
        *(
            f"    near-twin {ALWAYS_FITTED.get(name, name)}: {why}"
            for name, why in cls.near_twins.items()
        ),
    ]


def needs_words(needs: Sequence[str]) -> str:
    """Text of the requirements ``needs``, keys of ``NEEDS``, such as ``velocity (the joint's velocity)``."""
    return ", ".join(f"{word} ({NEEDS[word]})" for word in needs)


def parameter_words(p: Parameter) -> str:
    """Text of a parameter, such as ``F: torque_nm [N·m], absent at 0, 0 … 20, typically 0.4``."""
    absent = "shapes the effect" if p.absent is None else f"absent at {p.absent:g}"
    return f"{p.symbol}: {p.name} [{p.unit}], {absent}, {p.low:g} … {p.high:g}, typically {p.typical:g}"
