"""Lift Block: the right hand lifts a block from the table. A task of an outside package."""

from lift_block.scene import LiftBlock as LiftBlock
