"""What the pictures of a plan show, pixel by pixel."""

import numpy as np

from lerobot_hdp.drawing import (
    BOX_GAP,
    BOX_HEIGHT,
    FAINT,
    GIVEN,
    MARGIN,
    MASK_WORD,
    PAPER,
    SCENE_HEIGHT,
    PlanPicture,
    draw_plan,
)
from lerobot_hdp.plan import plan_rows

PATH = np.array([[100.0, 50.0], [300.0, 50.0], [300.0, 200.0]])
SCENE = np.zeros((SCENE_HEIGHT, 640, 3), np.uint8)
WHITE = (255, 255, 255)


def picture(words=(), given=None, step_ends=None, gripper=(1.0, 0.0, 1.0)):
    rows = plan_rows(len(words), len(PATH), step_ends)
    return draw_plan(PlanPicture(SCENE, PATH, np.array(gripper), words, rows, given))


def test_waypoints_are_filled_where_the_gripper_is_closed():
    drawn = picture()
    at = [drawn.getpixel((int(x), int(y))) for x, y in PATH]
    assert at[0] == at[2] == PAPER
    assert at[1] not in (PAPER, (0, 0, 0))
    assert drawn.getpixel((200, 50)) != (0, 0, 0)  # the line between two
    assert drawn.getpixel((200, 120)) == (0, 0, 0)


def test_symbols_stand_in_the_rows_of_their_steps():
    words, given = ["PICK", "A", MASK_WORD, "B"], [True, False, False, False]
    drawn = picture(words, given, step_ends=[(2, 1), (4, 3)])
    in_first_column = MARGIN + 5
    in_second_column = MARGIN + 5 + (640 - 2 * MARGIN + BOX_GAP) // 6
    first_row = SCENE_HEIGHT + MARGIN + BOX_HEIGHT + BOX_GAP + 5
    second_row = first_row + BOX_HEIGHT + BOX_GAP
    colours = [drawn.getpixel((x, y)) for y in (first_row, second_row) for x in (in_first_column, in_second_column)]
    assert colours == [GIVEN, WHITE, FAINT, WHITE]
    assert drawn.getpixel((in_second_column + in_second_column, first_row)) == PAPER
