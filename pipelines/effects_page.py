"""``make pictures`` writes docs/effects.md, too: every registered effect, its parameters, and what it is."""

from pathlib import Path

from taccorl.sim.effects import effects

PAGE = Path("docs/effects.md")
_LINKS = {"kp": "K_p", "kd": "K_d", "torque_ff": "T_ref", "k_n": "k_n", "k_d": "k_d"}
"""Numbers that are always fitted; all else is an effect."""


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
    for name in effects:
        lines += about(name)
    return "\n".join(lines) + "\n"


def about(name: str) -> list[str]:
    """The section of one effect: what it is, in words for somebody who has never met it."""
    cls = effects.get(name)
    lines = ["", f"## {name}", "", f"`{cls.equation}`", "", cls.in_words, ""]
    lines += [f"- **What it does to a policy:** {cls.at_a_policy}", f"- **What to record:** {cls.to_record}"]
    lines += [
        f"- **Looks like {_LINKS.get(other, f'[{other}](#{other})')}:** {why}" for other, why in cls.near_twins.items()
    ]
    return lines


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
    print(PAGE)
