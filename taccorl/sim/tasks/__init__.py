"""Tasks, one file each: parts, reset, predicates of success and failure, subtasks of each arm."""

from taccorl.plugins import Registry
from taccorl.sim.tasks.task import Task

tasks: Registry[type[Task]] = Registry("task", "taccorl.sim.tasks")
