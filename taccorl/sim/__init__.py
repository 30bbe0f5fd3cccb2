"""The MuJoCo twin of the bench: robot, touch, tasks, effects, environments."""
