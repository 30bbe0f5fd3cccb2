"""Assembly #2: a plug goes into an open cradle in the air."""

from taccorl.tasks.assembly_2.scene import Assembly2 as Assembly2
