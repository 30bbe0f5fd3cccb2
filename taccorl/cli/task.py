"""taccorl task new NAME [--out=NAME]

Write a working task of your own: a package of one module with scene, goal and scripted expert, and a MimicGen spec. Once it is
installed, collect, augment, post-train and evaluate know the task.
"""

from dataclasses import dataclass
from pathlib import Path

from taccorl.cli.effects import NewConfig, check_new
from taccorl.cli.parse import parse
from taccorl.errors import TaccorlError
from taccorl.lineage.destinations import write_new


@dataclass(kw_only=True)
class NewTaskConfig(NewConfig):
    """Write an example of a task of your own."""


def main(argv: list[str]) -> int:
    """Run ``taccorl task`` with the words ``argv`` after it; returns the exit status 0: written."""
    if argv[:1] not in (["new"], ["-h"], ["--help"]):
        raise TaccorlError("say what: taccorl task new NAME")
    config = parse(
        NewTaskConfig,
        argv[argv[0] == "new" :],
        positional="name",
        prog="taccorl task new",
    )
    from taccorl.sim.task import tasks

    check_new("task", config.name, tasks)
    out = config.out or Path(config.name)
    package = out / config.name
    if package.exists():
        raise TaccorlError(
            f"{package}: is there already; nothing was changed: give another --out, or remove it"
        )
    package.mkdir(parents=True)
    for path in sorted((Path(__file__).parents[1] / "tasks" / "example").glob("*.txt")):
        text = path.read_text(encoding="utf-8").replace("lift_block", config.name)
        place = out if path.stem == "pyproject.toml" else package
        write_new(
            place / path.stem,
            text.replace("LiftBlock", config.name.title().replace("_", "")),
        )
    print(
        f"wrote {package / '__init__.py'}: change the scene, the goal and the expert there"
    )
    print(
        f"next: python -m pip install --editable {out}; taccorl collect --task={config.name} --episodes=1"
    )
    return 0
