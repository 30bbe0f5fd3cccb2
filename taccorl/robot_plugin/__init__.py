"""From policies to robots through LeRobot's own commands: touch for any LeRobot robot, safety, a surrogate robot, the PiPERs.

LeRobot finds the robots through ``taccorl.lerobot_plugin``, which imports ``config_robots``.
"""

DEFAULT_PORT = 8730  # TCP port of a surrogate on this machine
LOST_S = 0.3  # [s] without any message of a surrogate after which its connection counts as lost
MOST_PX = 2048  # Most rows and columns of a camera's pictures
