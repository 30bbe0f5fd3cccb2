"""Scripted demonstrators, one file a task: they stand in for a teleoperator on machines without one."""

from taccorl.demos.experts.scripted import ScriptedExpert
from taccorl.plugins import Registry

experts: Registry[type[ScriptedExpert]] = Registry("expert", "taccorl.demos.experts")
