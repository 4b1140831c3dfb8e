"""What LeRobot's plugin discovery imports: registers policies, their processor steps and the environments."""

import gym_hdp_tasks.env_config
import lerobot_hdp.baselines.configuration_ablations
import lerobot_hdp.baselines.configuration_hierarchical
import lerobot_hdp.configuration_hdp
import lerobot_hdp.processor_hdp
from lerobot_hdp.lerobot_workarounds import shorten_torchcodec_warning

shorten_torchcodec_warning()
