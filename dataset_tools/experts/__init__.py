"""Scripted experts, one for each task."""

from dataset_tools.demonstration import Expert

from .block_sorting_2d import sort_blocks_2d

EXPERTS: dict[str, Expert] = {"hdp/BlockSorting2D-v0": sort_blocks_2d}
"""Gymnasium id to the expert that solves it."""
