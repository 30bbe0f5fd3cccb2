"""``make pictures`` completes docs/effects.md, too: the parameters of each effect, and what it acts on, are the registry's.

The introduction, the texts of the sections and the last table are written in the page itself; ``taccorl effects`` prints them.
"""

from pathlib import Path

from taccorl.errors import TaccorlError
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Effect
from taccorl.sim.effects.prose import PAIRS, page

PAGE = Path("docs/effects.md")


def text() -> str:
    """The page, with a section for each registered effect of the project."""
    sections, _, table = page().partition(PAIRS)
    lines = [sections.split("\n\n## ")[0]]
    for cls in (cls for cls in map(effects.get, effects) if cls.__module__.startswith("taccorl.")):
        if not cls.equation:
            raise TaccorlError(f"{PAGE}: write a section about {cls.name} first, in the form of the others")
        lines += section(cls)
    return "\n".join(lines) + f"\n{PAIRS}{table}"


def section(cls: type[Effect]) -> list[str]:
    """Return lines of Markdown: the section about an effect. Parameters with the same numbers share a line."""
    part, numbers = f"({', '.join(cls.kinds())})", dict[str, list[str]]()
    for p in cls.parameters():
        unit = "" if p.unit == "1" else p.unit
        absent = ", shape" if p.absent is None else f", absent at {p.absent:g}" if p.absent else ""
        text = f"{p.typical:g} ({p.low:g}…{p.high:g}) {unit}".rstrip() + absent
        numbers.setdefault(text, []).append(f"`{p.name}` {p.symbol}")
    lines = ["", f"## {cls.name}", "", f"`{cls.equation}` {part}", "", cls.in_words, ""]
    lines += [f"- {', '.join(names)}: {text}" for text, names in numbers.items()]
    return [*lines, f"- **Policy:** {cls.at_a_policy}", f"- **Record:** {cls.to_record}"]


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
    print(PAGE)
