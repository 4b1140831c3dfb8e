"""Scripted experts, one for each task."""

from dataset_tools.demonstration import Expert

from .block_sorting_2d import sort_blocks_2d
from .xarm_arrange_blocks import arrange_blocks
from .xarm_sorting import sort_blocks
from .xarm_tool_use import drag_and_stack, drag_and_stack_red_last

EXPERTS: dict[str, Expert] = {
    "hdp/BlockSorting2D-v0": sort_blocks_2d,
    "hdp/XArmSorting-v0": sort_blocks,
    "hdp/XArmArrangeBlocks-v0": arrange_blocks,
    "hdp/XArmToolUse-v0": drag_and_stack,
    "hdp/XArmToolUseRedOnTop-v0": drag_and_stack_red_last,
}
"""Gymnasium id to the expert that solves it."""
