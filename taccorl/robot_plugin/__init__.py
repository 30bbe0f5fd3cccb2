"""From policies to robots through LeRobot's own commands: touch for any LeRobot robot, safety, a surrogate robot, the PiPERs.

LeRobot finds the robots through ``taccorl.lerobot_plugin``, which imports ``config_robots``.
"""
