"""Tasks, one file each: parts, reset, what counts as success and failure, each arm's subtasks."""

from taccorl.plugins import Registry
from taccorl.sim.tasks.task import Task

tasks: Registry[type[Task]] = Registry("task", "taccorl.sim.tasks")
