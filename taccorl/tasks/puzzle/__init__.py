"""Do Puzzle: circle, heart and triangle go into their holes in a tray."""

from taccorl.tasks.puzzle.scene import Puzzle as Puzzle
