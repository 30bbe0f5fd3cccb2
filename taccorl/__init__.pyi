"""Types of what ``import taccorl`` gives; ``taccorl.api`` documents it."""

from taccorl.api import add_effect as add_effect
from taccorl.api import compare as compare
from taccorl.api import diagnose as diagnose
from taccorl.api import ingest as ingest
from taccorl.api import load_episode as load_episode
from taccorl.api import load_robot as load_robot
from taccorl.api import plot as plot
from taccorl.api import read_measurements as read_measurements
from taccorl.errors import TaccorlError as TaccorlError

__version__: str
