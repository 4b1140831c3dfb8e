"""Record the clips of `docs/tasks/`: the expert at work, with the step of its plan that is being done.

MUJOCO_GL=egl python -m benchmarks.task_clips
"""

from pathlib import Path

import cv2
import gymnasium as gym
import mujoco
import numpy as np
from PIL import Image

import gym_hdp_tasks  # noqa: F401 (registers the tasks)
from dataset_tools.demonstration import expert_generator
from dataset_tools.experts import EXPERTS

FOLDER = Path(__file__).parents[1] / "docs" / "tasks"
FRAMES_PER_SECOND = 12
"""Of the clip."""
CAPTURES_PER_SECOND = 3
"""Of simulated time: the clips run at four times the robot's speed."""
WIDTH, HEIGHT, CAPTION_HEIGHT = 400, 300, 26
QUALITY = 60
SEED = 3


def record(gym_id: str) -> list[np.ndarray]:
    """Frames (HEIGHT + CAPTION_HEIGHT, WIDTH, 3) of one demonstration, up to the end of its plan."""
    env = gym.make(gym_id, render_mode="rgb_array", disable_env_checker=True).unwrapped
    env.reset(seed=SEED)
    demonstration = EXPERTS[gym_id](env, expert_generator(SEED))
    physics_steps_per_capture = round(1 / CAPTURES_PER_SECOND / env.model.opt.timestep)
    frames = []
    for step, waypoint in enumerate(demonstration.waypoints[: demonstration.steps[-1].stop]):
        current = next(plan_step for plan_step in demonstration.steps if plan_step.stop > step)
        controls, _ = env.controls(waypoint)
        for number, control in enumerate(controls, start=1):
            env.data.ctrl[:] = control
            mujoco.mj_step(env.model, env.data)
            if number % physics_steps_per_capture == 0:
                frames.append(captioned(env.render(), " ".join(current.symbols)))
    env.close()
    return frames


def captioned(image: np.ndarray, words: str) -> np.ndarray:
    """The image, scaled down, over a strip with words."""
    small = cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    strip = np.full((CAPTION_HEIGHT, WIDTH, 3), 255, dtype=np.uint8)
    cv2.putText(strip, words, (8, 18), cv2.FONT_HERSHEY_DUPLEX, 0.5, (60, 60, 60), 1, cv2.LINE_AA)
    return np.vstack([small, strip])


def main() -> None:
    for gym_id in EXPERTS:
        if "XArm" not in gym_id or "RedOnTop" in gym_id:
            continue
        frames = record(gym_id)
        images = [Image.fromarray(frame) for frame in frames]
        path = FOLDER / f"{gym_id.removeprefix('hdp/').removesuffix('-v0')}.webp"
        duration = 1000 // FRAMES_PER_SECOND
        images[0].save(path, save_all=True, append_images=images[1:], duration=duration, loop=0, quality=QUALITY)
        print(f"{path.name}: {len(frames)} frames, {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
