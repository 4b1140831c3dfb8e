"""What the paper reports (Høeg et al. 2026): its table of simulation results and the figures in its text."""

SCORES: dict[str, dict[str, tuple[int, int]]] = {
    "xarm_sorting": {
        "diffuser": (46, 6),
        "joint_diffuser": (42, 5),
        "separate_diffuser": (39, 5),
        "hd": (34, 5),
        "chd": (37, 4),
        "hdp": (86, 5),
    },
    "xarm_arrange_blocks": {
        "diffuser": (66, 7),
        "joint_diffuser": (61, 6),
        "separate_diffuser": (62, 4),
        "hd": (29, 3),
        "chd": (23, 2),
        "hdp": (74, 10),
    },
    "xarm_tool_use": {
        "diffuser": (60, 8),
        "joint_diffuser": (64, 7),
        "separate_diffuser": (58, 4),
        "hd": (4, 1),
        "chd": (3, 1),
        "hdp": (78, 4),
    },
    "xarm_sorting_images": {
        "diffuser": (62, 7),
        "joint_diffuser": (54, 8),
        "separate_diffuser": (56, 9),
        "hdp": (83, 15),
    },
}
"""Of each task and method, mean score and its standard deviation, in %: three seeds, the last 10 checkpoints, 50 starts
each. The last task is the first one from an image alone."""
ADHERENCE: dict[str, tuple[int, int]] = {"hdp": (93, 6), "joint_diffuser": (32, 27), "separate_diffuser": (32, 22)}
"""P(red on top | all stacked) with the prompt "red last", in %, and its standard deviation. Without: 30 to 35 %."""
LATENCY_OVER_DIFFUSER: dict[str, int] = {"hdp": 17, "hd": 93, "chd": 93}
"""Time of a plan, in % more than Diffuser's. The paper gives one figure for "Hierarchical Diffusion"."""
TRAINING = "30 minutes to 15 hours on A100 GPUs"
