"""What the paper reports (Høeg et al. 2026): its table of simulation results and the figures in its text."""

SCORES: dict[str, dict[str, tuple[int, int]]] = {
    "diffuser": {"xarm_sorting": (46, 6), "xarm_arrange_blocks": (66, 7), "xarm_tool_use": (60, 8)},
    "joint_diffuser": {"xarm_sorting": (42, 5), "xarm_arrange_blocks": (61, 6), "xarm_tool_use": (64, 7)},
    "separate_diffuser": {"xarm_sorting": (39, 5), "xarm_arrange_blocks": (62, 4), "xarm_tool_use": (58, 4)},
    "hd": {"xarm_sorting": (34, 5), "xarm_arrange_blocks": (29, 3), "xarm_tool_use": (4, 1)},
    "chd": {"xarm_sorting": (37, 4), "xarm_arrange_blocks": (23, 2), "xarm_tool_use": (3, 1)},
    "hdp": {"xarm_sorting": (86, 5), "xarm_arrange_blocks": (74, 10), "xarm_tool_use": (78, 4)},
}
"""Mean score and its standard deviation, in %: three seeds, the last 10 checkpoints, 50 starts each."""
ADHERENCE: dict[str, tuple[int, int]] = {"hdp": (93, 6), "joint_diffuser": (32, 27), "separate_diffuser": (32, 22)}
"""P(red on top | all stacked) with the prompt "red last", in %, and its standard deviation. Without: 30 to 35 %."""
LATENCY_OVER_DIFFUSER: dict[str, int] = {"hdp": 17, "hd": 93, "chd": 93}
"""Time of a plan, in % more than Diffuser's. The paper gives one figure for "Hierarchical Diffusion"."""
TRAINING = "30 minutes to 15 hours on A100 GPUs"
