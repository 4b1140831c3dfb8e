"""What LeRobot's plugin discovery imports: registers the policy and the environment configs, nothing else."""

import gym_hdp_tasks.env_config
import lerobot_hdp.configuration_hdp  # noqa: F401
