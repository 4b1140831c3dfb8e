"""Gymnasium tasks that need a long motion and a plan behind it. Importing this package registers their ids."""

import os
import sys

import gymnasium as gym

from .task import PAD, PlanningTask

if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
    os.environ.setdefault("MUJOCO_GL", "egl")  # MuJoCo, which reads this when it is imported, would look for a display

__all__ = ["PAD", "PlanningTask"]

gym.register(id="hdp/BlockSorting2D-v0", entry_point="gym_hdp_tasks.block_sorting_2d:BlockSorting2DEnv")
gym.register(id="hdp/XArmSorting-v0", entry_point="gym_hdp_tasks.xarm_sorting:XArmSortingEnv")
gym.register(id="hdp/XArmArrangeBlocks-v0", entry_point="gym_hdp_tasks.xarm_arrange_blocks:XArmArrangeBlocksEnv")
gym.register(id="hdp/XArmToolUse-v0", entry_point="gym_hdp_tasks.xarm_tool_use:XArmToolUseEnv")
gym.register(id="hdp/XArmToolUseRedOnTop-v0", entry_point="gym_hdp_tasks.xarm_tool_use:XArmToolUseRedOnTopEnv")
