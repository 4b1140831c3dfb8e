"""A plan as one self-contained web page, for a browser without a network: `plan_page.html` with the plan in it."""

import base64
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from .plan import StepEnds, plan_rows

TEMPLATE = Path(__file__).with_name("plan_page.html")
IMAGE_QUALITY = 80


class PageState(NamedTuple):
    """The plan after a number of denoising steps.

    Attributes:
        step: the number.
        path: (H_c, 2) pixel coordinates of the waypoints in the scene.
        gripper: (H_c,) gripper opening of each waypoint.
        words: a word for each token, None where it is still masked.
    """

    step: int
    path: np.ndarray
    gripper: np.ndarray
    words: Sequence[str | None]


class PlanPage(NamedTuple):
    """What a page shows.

    Attributes:
        about: short texts, shown above the plan.
        start: (height, width, 3) uint8 image of the scene before the plan is executed.
        frames: such images after each waypoint; the last one stands for all that are missing.
        states: the denoising, the plan itself last.
        probabilities: with which each token of the plan was drawn.
        given: which tokens the prompt gave.
        step_ends: the tokens and waypoints until which each step lasts; None: not known.
    """

    about: Sequence[str]
    start: np.ndarray
    frames: Sequence[np.ndarray]
    states: Sequence[PageState]
    probabilities: Sequence[float]
    given: Sequence[bool]
    step_ends: StepEnds | None


def write_page(page: PlanPage, path: Path) -> None:
    """Write a page to a file."""
    height, width = page.start.shape[:2]
    final = page.states[-1]
    data = {
        "about": list(page.about),
        "width": width,
        "height": height,
        "start": _data_url(page.start),
        "frames": [_data_url(frame) for frame in page.frames],
        "states": [
            {
                "step": state.step,
                "path": np.nan_to_num(state.path).round(1).tolist(),
                "gripper": state.gripper.round(2).tolist(),
                "words": list(state.words),
            }
            for state in page.states
        ],
        "words": list(final.words),
        "gripper": final.gripper.round(2).tolist(),
        "probabilities": [round(probability, 2) for probability in page.probabilities],
        "given": list(page.given),
        "steps": [
            {"tokens": _bounds(row.tokens)} | ({"waypoints": _bounds(row.waypoints)} if row.waypoints else {})
            for row in plan_rows(len(final.words), len(final.path), page.step_ends)
        ],
    }
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(TEMPLATE.read_text(encoding="utf-8").replace("PLAN_DATA;", text + ";"), encoding="utf-8")


def _bounds(part: slice) -> list[int]:
    return [part.start, part.stop]


def _data_url(image: np.ndarray) -> str:
    file = io.BytesIO()
    Image.fromarray(image).save(file, format="WEBP", quality=IMAGE_QUALITY)
    return "data:image/webp;base64," + base64.b64encode(file.getvalue()).decode("ascii")
