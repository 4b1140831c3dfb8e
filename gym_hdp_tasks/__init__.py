"""Gymnasium tasks that need a long motion and a plan behind it. Importing this package registers their ids."""

import ctypes.util
import os
import sys

import gymnasium as gym

from .task import PAD, PlanningTask

# MuJoCo, which reads this when it is imported, would look for a display; with `egl` and no EGL, its import fails.
_has_display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
if sys.platform == "linux" and not _has_display and ctypes.util.find_library("EGL"):
    os.environ.setdefault("MUJOCO_GL", "egl")

__all__ = ["PAD", "PlanningTask"]

# An episode of sorting in the plane is as long as its parameters say, so that no length is registered.
gym.register("hdp/BlockSorting2D-v0", "gym_hdp_tasks.block_sorting_2d:BlockSorting2DEnv")
gym.register("hdp/XArmSorting-v0", "gym_hdp_tasks.xarm_sorting:XArmSortingEnv", max_episode_steps=145)
gym.register("hdp/XArmArrangeBlocks-v0", "gym_hdp_tasks.xarm_arrange_blocks:XArmArrangeBlocksEnv", max_episode_steps=25)
gym.register("hdp/XArmToolUse-v0", "gym_hdp_tasks.xarm_tool_use:XArmToolUseEnv", max_episode_steps=61)
gym.register("hdp/XArmToolUseRedOnTop-v0", "gym_hdp_tasks.xarm_tool_use:XArmToolUseRedOnTopEnv", max_episode_steps=61)
