"""``make pictures`` writes the sections of docs/effects.md, too, from the registry; the introduction is the page's own."""

from pathlib import Path

from taccorl.errors import TaccorlError
from taccorl.sim.effects import effects, prose
from taccorl.sim.effects.effect import Effect

PAGE = Path(__file__).parents[1] / "docs" / "effects.md"


def text() -> str:
    """The page, with a section for each registered effect of the project."""
    lines = [PAGE.read_text(encoding="utf-8").split("\n\n## ")[0].rstrip()]
    for cls in (
        cls
        for cls in map(effects.get, effects)
        if cls.__module__.startswith("taccorl.")
    ):
        if not cls.equation:
            raise TaccorlError(
                f"{prose.PAGE}: write a section about {cls.name} first, in the form of the others"
            )
        lines += section(cls)
    return "\n".join(lines) + "\n"


def section(cls: type[Effect]) -> list[str]:
    """Return lines of Markdown: the section about an effect. Parameters with the same numbers share a line."""
    part, numbers = f"({', '.join(cls.kinds())})", dict[str, list[str]]()
    for p in cls.parameters():
        unit = "" if p.unit == "1" else p.unit
        absent = (
            ", shape"
            if p.absent is None
            else f", absent at {p.absent:g}"
            if p.absent
            else ""
        )
        text = f"{p.typical:g} ({p.low:g}…{p.high:g}) {unit}".rstrip() + absent
        numbers.setdefault(text, []).append(f"`{p.name}` {p.symbol}")
    lines = ["", f"## {cls.name}", "", f"`{cls.equation}` {part}", "", cls.in_words, ""]
    return lines + [f"- {', '.join(names)}: {text}" for text, names in numbers.items()]


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
    print(PAGE)
