"""Assembly #1: a tenon goes into a mortise in the air."""

from taccorl.tasks.assembly_1.scene import Assembly1 as Assembly1
