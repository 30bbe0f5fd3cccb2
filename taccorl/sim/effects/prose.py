"""Texts about effects: the sections of ``effects.md`` beside this file, which ``taccorl effects`` and docs/effects.md show."""

import re
from collections import defaultdict
from collections.abc import Mapping
from functools import cache
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from taccorl.errors import TaccorlError

ALWAYS_FITTED = {
    "kp": "K_p",
    "kd": "K_d",
    "torque_ff": "T_ref",
    "k_n": "k_n",
    "k_d": "k_d",
}
"""Near-twins that are not effects but numbers that every fit contains → their notation."""
PAGE = Path(__file__).with_name("effects.md")
PAIRS = "\n## Tell them apart\n"
"""Heading of the table of effects that look alike, the last section of ``PAGE``."""
_SECTION = re.compile(
    r"`(?P<equation>[^`\n]+)`\n\n(?P<in_words>[^\n]+)\n\n"
    r"- \*\*Policy:\*\* (?P<at_a_policy>[^\n]+)\n- \*\*Record:\*\* (?P<to_record>[^\n]+)\n\s*"
)
_ROW = re.compile(r"^\| ([^|\n]+) \| ([^|\n]+) \| ([^|\n]+) \|$", re.MULTILINE)


class Prose(NamedTuple):
    """Texts about one effect, under the names of ``Effect``."""

    equation: str = ""
    in_words: str = ""
    at_a_policy: str = ""
    to_record: str = ""
    near_twins: Mapping[str, str] = MappingProxyType({})


def prose(name: str) -> Prose:
    """Texts about the effect ``name``; empty ones if there is no section about it, as of an outside package's effect."""
    return _sections().get(name, Prose()) if name else Prose()


@cache
def _sections() -> dict[str, Prose]:
    fitted, found = (
        {words: name for name, words in ALWAYS_FITTED.items()},
        dict[str, Prose](),
    )
    sections, _, table = PAGE.read_text(encoding="utf-8").partition(PAIRS)
    twins: dict[str, dict[str, str]] = defaultdict(dict)
    for one, other, why in _ROW.findall(table.partition("|---|---|---|\n")[2]):
        for a, b in product(
            *(
                [fitted.get(name) or str(name) for name in names.split(", ")]
                for names in (one, other)
            )
        ):
            twins[a][b] = twins[b][a] = why
    for section in sections.split("\n## ")[1:]:
        name, _, text = section.partition("\n\n")
        if (parts := _SECTION.fullmatch(text)) is None:
            raise TaccorlError(
                f"{PAGE}: {name}: its section must have the form of the others"
            )
        words: dict[str, Any] = {**parts.groupdict(), "near_twins": twins.pop(name, {})}
        found[name] = Prose(**words)
    if unknown := sorted(twins.keys() - ALWAYS_FITTED):
        raise TaccorlError(
            f"{PAGE}: the last table names {unknown[0]}, which has no section"
        )
    return found
