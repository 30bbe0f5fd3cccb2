"""Scripted experts: programs that demonstrate a task in place of a person. A task names its own (``Task.expert``)."""

import pkgutil

from taccorl.errors import TaccorlError
from taccorl.sim.task import Task, tasks
from taccorl.tasks.experts.scripted import ScriptedExpert


def expert_of(task: Task | type[Task]) -> type[ScriptedExpert]:
    """The scripted expert that ``task`` names.

    Raises:
        TaccorlError: the task names none, or a class that cannot be imported or is not a scripted expert.
    """
    if task.expert is None:
        have = ", ".join(tasks_with_expert())
        raise TaccorlError(
            f"task {task.name} has no scripted expert; tasks with one: {have}. To add one, write a ScriptedExpert and name it "
            'in the task: expert = "module:Class"'
        )
    try:
        expert = pkgutil.resolve_name(task.expert)
    except (ImportError, AttributeError, ValueError) as error:
        raise TaccorlError(
            f"task {task.name}: its expert {task.expert!r} cannot be imported: {error}"
        ) from error
    if not (isinstance(expert, type) and issubclass(expert, ScriptedExpert)):
        raise TaccorlError(
            f"task {task.name}: its expert {task.expert!r} is no subclass of ScriptedExpert: {expert!r}"
        )
    return expert


def tasks_with_expert() -> tuple[str, ...]:
    """Names of the registered tasks that have a scripted expert."""
    return tuple(name for name in tasks if tasks.get(name).expert)
