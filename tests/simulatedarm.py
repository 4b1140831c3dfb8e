"""An arm as LeRobot knows one, simulated: what `lerobot-rollout --robot.type=simulated_arm` moves.

LeRobot finds the class of a robot by the name and the module of its configuration, hence this file's name.
"""

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from lerobot.robots import Robot, RobotConfig

from gym_hdp_tasks.env_config import HDPEnv


@RobotConfig.register_subclass("simulated_arm")
@dataclass
class SimulatedArmConfig(RobotConfig):
    """Where the arm stands: a task with cameras."""

    env: HDPEnv = field(default_factory=HDPEnv)


class SimulatedArm(Robot):
    """One arm; its `sent` are the waypoints that it was sent, and its `seen` the first image of each camera.

    Connecting it resets the scene to seed 0, and PyTorch's generator, so that a test can make the same plan. When the
    episode is over, it acts as a user who presses Ctrl-C.
    """

    config_class = SimulatedArmConfig
    name = "simulated_arm"
    last: "SimulatedArm"

    def __init__(self, config: SimulatedArmConfig):
        super().__init__(config)
        self.env = gym.make(config.env.gym_id, disable_env_checker=True, **config.env.gym_kwargs)
        self.cameras: dict[str, gym.Space] = self.env.observation_space["pixels"].spaces
        self.sent: list[np.ndarray] = []
        SimulatedArm.last = self

    @property
    def observation_features(self) -> dict[str, Any]:
        return {**self.action_features, **{name: space.shape for name, space in self.cameras.items()}}

    @property
    def action_features(self) -> dict[str, type]:
        return {f"{name}.pos": float for name in ("x", "y", "z", "gripper")}

    is_connected, is_calibrated = True, True

    def connect(self, calibrate: bool = True) -> None:
        observation, _ = self.env.reset(seed=0)
        self.seen = self.pixels = observation["pixels"]
        torch.manual_seed(0)

    def get_observation(self) -> dict[str, Any]:
        return {**dict.fromkeys(self.action_features, 0.0), **self.pixels}

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        self.sent.append(np.array([action[name] for name in self.action_features], dtype=np.float32))
        observation, _, terminated, truncated, _ = self.env.step(self.sent[-1])
        self.pixels = observation["pixels"]
        if terminated or truncated:
            raise KeyboardInterrupt
        return action

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def disconnect(self) -> None:
        self.env.close()
