"""Tasks, one folder each: scene with reset, predicates and subtasks, geometry of the parts, scripted expert, MimicGen spec.

``taccorl.sim.task.tasks`` imports this package when a task is asked for; nothing else names the folders.
"""

import taccorl.sim.bench  # noqa: F401  registers the empty bench, which belongs to the simulator, beside them
