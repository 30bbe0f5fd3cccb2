"""``make pictures`` writes docs/effects.md, too: every registered effect, its parameters, and what it is."""

from pathlib import Path

from taccorl.sim.effects import effects
from taccorl.sim.effects.catalogue import section

PAGE = Path("docs/effects.md")


def text() -> str:
    """The page."""
    lines = [
        "# Physical effects",
        "",
        "Written by `make pictures` from `taccorl/sim/effects/`; do not edit. `taccorl effects` prints the same. A `twin.yaml`",
        "lists the effects that a twin has:",
        "",
        "```yaml",
        "effects:",
        "- {effect: coulomb_friction, torque_nm: 0.41, arm: left, joints: [joint5]}",
        "```",
        "",
        "At its absent value an effect is not built at all, and the twin is the same to the last bit. A parameter without one",
        "only shapes the effect. A number in the unit `reading` is a share of the normalised reading: of FlexiTac pads 1 is 75",
        "counts, of a sensor of cells a tenth of what it is rated for.",
        "",
        "For an effect of your own, `taccorl effects new my_effect --out=my_effect.py` writes an example with its test. It joins",
        "the others by the entry point `taccorl.plugins`, or as a file in `taccorl/sim/effects/`.",
        "",
        "| effect | acts on | parameter | unit | absent | from | to | typical | source |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name in effects:
        cls = effects.get(name)
        for p in cls.parameters():
            absent = "" if p.absent is None else f"{p.absent:g}"
            cells = [name, ", ".join(cls.kinds()), p.name, p.unit, absent]
            cells += [f"{p.low:g}", f"{p.high:g}", f"{p.typical:g}", p.source]
            lines.append("| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |")
    for name in effects:
        lines += section(effects.get(name))
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
    print(PAGE)
