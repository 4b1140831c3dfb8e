"""What LeRobot's plugin discovery imports: registers policies, their processor steps and the environments."""

import gym_hdp_tasks.env_config  # noqa: F401
import lerobot_hdp.configuration_hdp
import lerobot_hdp.processor_hdp  # noqa: F401
from lerobot_hdp.torchcodec_warning import shorten_torchcodec_warning

shorten_torchcodec_warning()
