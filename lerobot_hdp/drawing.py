"""Pictures of a plan: the motion over the scene, the symbols beneath it."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from .plan import TOKENS_PER_ROW, PlanRow

MASK_WORD = ""
"""How a masked token is given to `draw_symbols`: it becomes an empty box."""

SCENE_HEIGHT = 480
MARGIN = 16
BOX_HEIGHT, BOX_GAP = 30, 6
FONT_SIZE = 17
PAPER, INK, FAINT = (250, 249, 246), (40, 40, 40), (200, 198, 192)
GIVEN = (214, 232, 250)
GRIPPER_CLOSED_BELOW = 0.5


class PlanPicture(NamedTuple):
    """What one picture shows.

    Attributes:
        scene: (height, width, 3) uint8 image of the scene.
        path: (H, 2) pixel coordinates of the waypoints in it.
        gripper: (H,) gripper opening of each waypoint; waypoints with a closed gripper are drawn filled.
        words: one word for each token, `MASK_WORD` where it is still masked; without PAD at the end.
        rows: in which they are written.
        given: which words the prompt gave, or None.
        caption: a line above the symbols.
    """

    scene: np.ndarray
    path: np.ndarray
    gripper: np.ndarray
    words: Sequence[str]
    rows: Sequence[PlanRow]
    given: Sequence[bool] | None = None
    caption: str = ""


def draw_plan(picture: PlanPicture) -> Image.Image:
    """The motion over the scene, and the symbolic plan beneath it."""
    scale = SCENE_HEIGHT / picture.scene.shape[0]
    width = round(picture.scene.shape[1] * scale)
    scene = cv2.resize(picture.scene, (width, SCENE_HEIGHT), interpolation=cv2.INTER_CUBIC)
    draw_motion(scene, picture.path * scale, picture.gripper)

    row_height = BOX_HEIGHT + BOX_GAP
    canvas = Image.new("RGB", (width, SCENE_HEIGHT + row_height * (len(picture.rows) + 1) + 2 * MARGIN), PAPER)
    canvas.paste(Image.fromarray(scene))
    draw = ImageDraw.Draw(canvas)
    top = SCENE_HEIGHT + MARGIN
    draw.text((MARGIN, top), picture.caption, fill=INK, font=ImageFont.load_default(FONT_SIZE))
    draw_symbols(draw, picture, (MARGIN, top + row_height), width - 2 * MARGIN)
    return canvas


def draw_motion(image: np.ndarray, path: np.ndarray, gripper: np.ndarray) -> None:
    """Draw a path into an image, from purple (first) to yellow (last), dots filled where the gripper is closed."""
    order = np.linspace(0, 255, len(path)).astype(np.uint8)
    colours = cv2.applyColorMap(order[:, None], cv2.COLORMAP_VIRIDIS)[:, 0, ::-1].tolist()
    points = np.nan_to_num(path).round().astype(int).tolist()
    for start, end, colour in zip(points, points[1:], colours, strict=False):
        cv2.line(image, start, end, colour, 2, cv2.LINE_AA)
    for point, colour, opening in zip(points, colours, gripper, strict=True):
        cv2.circle(image, point, 6, PAPER, cv2.FILLED, cv2.LINE_AA)
        cv2.circle(image, point, 6, colour, cv2.FILLED if opening < GRIPPER_CLOSED_BELOW else 2, cv2.LINE_AA)


def draw_symbols(draw: ImageDraw.ImageDraw, picture: PlanPicture, origin: tuple[int, int], width: int) -> None:
    """A box for each token; masked ones are empty, those of the prompt tinted."""
    font = ImageFont.load_default(FONT_SIZE)
    columns = max([TOKENS_PER_ROW, *(row.tokens.stop - row.tokens.start for row in picture.rows)])
    box_width = (width - BOX_GAP * (columns - 1)) / columns
    for number, row in enumerate(picture.rows):
        top = origin[1] + number * (BOX_HEIGHT + BOX_GAP)
        for column, position in enumerate(range(row.tokens.start, row.tokens.stop)):
            word, left = picture.words[position], origin[0] + column * (box_width + BOX_GAP)
            given = picture.given is not None and picture.given[position]
            fill = FAINT if word == MASK_WORD else GIVEN if given else "white"
            draw.rounded_rectangle((left, top, left + box_width, top + BOX_HEIGHT), 6, fill=fill, outline=FAINT)
            centre = (left + box_width / 2, top + BOX_HEIGHT / 2)
            draw.text(centre, word, fill=INK, font=font, anchor="mm")


def save_animation(frames: Sequence[Image.Image], path, frame_ms: int = 60, last_frame_ms: int = 2500) -> None:
    """Write a GIF that rests on its last frame."""
    durations = [frame_ms] * (len(frames) - 1) + [last_frame_ms]
    palette = [frame.quantize(colors=128, dither=Image.Dither.NONE) for frame in frames]
    palette[0].save(path, save_all=True, append_images=palette[1:], duration=durations, loop=0)
