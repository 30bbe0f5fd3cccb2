"""taccorl task new NAME [--out=NAME]

Write a working task of your own: a package of one module with scene, goal and scripted expert, and a MimicGen spec. Once it is
installed, collect, augment, post-train and evaluate know the task.
"""

from dataclasses import dataclass
from pathlib import Path

from taccorl.cli.effects import NewConfig, check_new, write_package
from taccorl.cli.parse import parse
from taccorl.errors import TaccorlError


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
    texts = Path(__file__).parents[1] / "tasks" / "example"
    package = write_package(config, "lift_block", [texts])
    out = package.parent
    print(
        f"wrote {package / '__init__.py'}: change the scene, the goal and the expert there"
    )
    print(
        f"next: python -m pip install --editable {out}; taccorl collect --task={config.name} --episodes=1"
    )
    return 0
