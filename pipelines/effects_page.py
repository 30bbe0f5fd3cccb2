"""``make pictures`` writes docs/effects.md, too: every registered effect with its parameters, bounds and absent values."""

from pathlib import Path

from taccorl.sim.effects import effects

PAGE = Path("docs/effects.md")


def text() -> str:
    """The page."""
    lines = [
        "# Physical effects",
        "",
        "Written by `make pictures` from `taccorl/sim/effects/`; do not edit. A `twin.yaml` lists those that a twin has:",
        "",
        "```yaml",
        "effects:",
        "- {effect: coulomb_friction, torque_nm: 0.41, arm: left, joints: [joint5]}",
        "```",
        "",
        "At its absent value an effect is not built at all, and the twin is the same to the last bit. A parameter without one",
        "only shapes the effect. An effect of your own is one file there, or one module under the entry point `taccorl.plugins`.",
        "",
        "| effect | parameter | unit | absent | from | to | typical | source |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in effects:
        for p in effects.get(name).parameters():
            absent = "" if p.absent is None else f"{p.absent:g}"
            cells = [name, p.name, p.unit, absent, f"{p.low:g}", f"{p.high:g}", f"{p.typical:g}", p.source]
            lines.append("| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
    print(PAGE)
