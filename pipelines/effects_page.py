"""``make pictures`` completes docs/effects.md, too: the table of parameters, and what each effect acts on, are the registry's.

The introduction and the texts of the sections are written in the page itself; ``taccorl effects`` prints them.
"""

from pathlib import Path

from taccorl.errors import TaccorlError
from taccorl.sim.effects import effects
from taccorl.sim.effects.catalogue import section
from taccorl.sim.effects.prose import page

PAGE = Path("docs/effects.md")
_TABLE = "| effect | acts on | parameter | unit | absent | from | to | typical | source |\n|---|---|---|---|---|---|---|---|---|"


def text() -> str:
    """The page, with a section for each registered effect of the project."""
    lines = [page().split(_TABLE)[0] + _TABLE]
    own = [cls for cls in map(effects.get, effects) if cls.__module__.startswith("taccorl.")]
    for cls in own:
        if not cls.equation:
            raise TaccorlError(f"{PAGE}: write a section about {cls.name} first, in the form of the others")
        for p in cls.parameters():
            absent = "" if p.absent is None else f"{p.absent:g}"
            cells = [cls.name, ", ".join(cls.kinds()), p.name, p.unit, absent]
            cells += [f"{p.low:g}", f"{p.high:g}", f"{p.typical:g}", p.source]
            lines.append("| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |")
    for cls in own:
        lines += section(cls)
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
    print(PAGE)
