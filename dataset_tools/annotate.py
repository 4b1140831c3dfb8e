"""Give a LeRobotDataset without symbolic plans the column that a planner learns them from.

Example:
    from lerobot.datasets import LeRobotDataset
    from dataset_tools.annotate import add_symbolic_plans
    from dataset_tools.demonstration import PlanStep

    # In episode 0 the cup is held from frame 40 on, and stands on the tray from frame 90 on; in episode 1 ...
    plans = [[PlanStep(("PICK", "CUP"), 40), PlanStep(("PLACE", "TRAY"), 90)], ...]
    add_symbolic_plans(LeRobotDataset("me/cups"), plans, "me/cups_with_plans", "outputs/cups_with_plans")
"""

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.dataset_tools import add_features
from lerobot.utils.constants import ACTION

from gym_hdp_tasks import PAD
from lerobot_hdp.lerobot_workarounds import shorten_torchcodec_warning
from lerobot_hdp.vocabulary import Vocabulary

from .demonstration import Demonstration, PlanStep, check_steps
from .language import SYMBOLIC_PLAN

shorten_torchcodec_warning()


def add_symbolic_plans(
    dataset: LeRobotDataset,
    plans: Sequence[Sequence[PlanStep]],
    repo_id: str,
    root: Path | str,
    vocabulary: Sequence[str] | None = None,
    symbolic_horizon: int | None = None,
) -> LeRobotDataset:
    """Copy a dataset, with what remains of the plan at each frame in the column `observation.symbolic_plan`.

    Args:
        dataset: to be copied, with all its episodes.
        plans: of each episode, its steps in words, and the frame at which each is done.
        repo_id: name of the new dataset.
        root: its folder.
        vocabulary: all symbols that its plans may have, PAD first; for a planner that is trained on with it, the
            planner's. None: PAD and the symbols of these plans, in alphabetical order.
        symbolic_horizon: tokens of a plan, which PAD fills up. None: as many as the longest has. Datasets that are to
            be merged need the same vocabulary and the same symbolic horizon.

    Raises:
        FileExistsError: the folder exists.
        ValueError: there is not one plan for each episode, no plan has a step, a step has the word PAD or one that the
            vocabulary lacks, a word cannot be a symbol, a plan is longer than the symbolic horizon, or the steps of an
            episode are not done one after the other, between its first frame and its end.
    """
    if Path(root).exists():
        raise FileExistsError(f"{root} exists already: delete it, or choose another folder")
    if len(plans) != dataset.meta.total_episodes:
        raise ValueError(f"there are {len(plans)} plans for {dataset.meta.total_episodes} episodes")
    lengths = dataset.meta.episodes["length"]
    for episode, (plan, length) in enumerate(zip(plans, lengths, strict=True)):
        check_steps(plan, length, f"episode {episode}")
        if any(PAD in step.symbols for step in plan):
            raise ValueError(f"a step of episode {episode} has the word {PAD}, which only fills plans up")
    symbols = {symbol for plan in plans for step in plan for symbol in step.symbols}
    vocabulary = [PAD, *sorted(symbols)] if vocabulary is None else list(vocabulary)
    Vocabulary(vocabulary)  # whether its words can be symbols
    if not symbols:
        raise ValueError("no plan has a step: there is nothing to learn")
    if symbolic_horizon is None:
        symbolic_horizon = max(sum(len(step.symbols) for step in plan) for plan in plans)
    token_ids = []
    for plan, length in zip(plans, lengths, strict=True):
        demonstration = Demonstration(np.empty((length, *dataset.meta.shapes[ACTION])), tuple(plan))
        token_ids += [demonstration.remaining_token_ids(frame, vocabulary, symbolic_horizon) for frame in range(length)]
    column = {"dtype": "int64", "shape": (symbolic_horizon,), "names": None, "info": {"vocabulary": vocabulary}}
    features = {SYMBOLIC_PLAN: (np.stack(token_ids), column)}
    try:
        return add_features(dataset, features, output_dir=root, repo_id=repo_id)
    except BaseException:
        shutil.rmtree(root, ignore_errors=True)  # half of a copy
        raise
