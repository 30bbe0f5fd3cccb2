"""Scripted experts, one file per task: they demonstrate in place of a person who teleoperates."""

from taccorl.demos.experts.scripted import ScriptedExpert
from taccorl.plugins import Registry

experts: Registry[type[ScriptedExpert]] = Registry("expert", "taccorl.demos.experts")
