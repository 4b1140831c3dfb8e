"""Film what is planned and executed, with the step of the plan that is being done.

MUJOCO_GL=egl python -m benchmarks.clips                       # docs/tasks/: the experts
MUJOCO_GL=egl python -m benchmarks.clips CHECKPOINT --prompt "... STACK red"   # docs/images/: a trained planner
"""

import argparse
from pathlib import Path

import cv2
import gymnasium as gym
import mujoco
import numpy as np
from PIL import Image

from dataset_tools.demonstration import PlanStep, expert_generator
from dataset_tools.experts import EXPERTS
from gym_hdp_tasks.task import PlanningTask
from lerobot_hdp.plan import plan_rows

from .evaluation import load, make_plans
from .pages import DOCS

FRAMES_PER_SECOND = 12
"""Of the clip."""
CAPTURES_PER_SECOND = 3
"""Of simulated time: the clips run at four times the robot's speed."""
WIDTH, HEIGHT, CAPTION_HEIGHT = 400, 300, 26
QUALITY = 60
SEED = 3


def film(env: gym.Env, waypoints: np.ndarray, steps: tuple[PlanStep, ...]) -> list[np.ndarray]:
    """Frames (HEIGHT + CAPTION_HEIGHT, WIDTH, 3) of a plan's execution, up to the end of its last step.

    Args:
        env: an X-Arm task that was just reset and renders.
        waypoints: (horizon, 4) actions.
        steps: of the symbolic plan.
    """
    env = env.unwrapped
    physics_steps_per_capture = round(1 / CAPTURES_PER_SECOND / env.model.opt.timestep)
    frames = []
    for number, waypoint in enumerate(waypoints[: steps[-1].stop]):
        current = next(step for step in steps if step.stop > number)
        controls, _ = env.controls(waypoint)
        for count, control in enumerate(controls, start=1):
            env.data.ctrl[:] = control
            mujoco.mj_step(env.model, env.data)
            if count % physics_steps_per_capture == 0:
                frames.append(captioned(env.render(), " ".join(current.symbols)))
    return frames


def captioned(image: np.ndarray, words: str) -> np.ndarray:
    """The image, scaled down, over a strip with words."""
    small = cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    strip = np.full((CAPTION_HEIGHT, WIDTH, 3), 255, dtype=np.uint8)
    cv2.putText(strip, words, (8, 18), cv2.FONT_HERSHEY_DUPLEX, 0.5, (60, 60, 60), 1, cv2.LINE_AA)
    return np.vstack([small, strip])


def save(frames: list[np.ndarray], path: Path) -> None:
    first, *others = (Image.fromarray(frame) for frame in frames)
    duration = 1000 // FRAMES_PER_SECOND
    first.save(path, save_all=True, append_images=others, duration=duration, loop=0, quality=QUALITY)
    print(f"{path.name}: {len(frames)} frames, {path.stat().st_size / 1000:.0f} kB")


def film_experts() -> None:
    """A demonstration of each X-Arm task, into `docs/tasks/`."""
    for gym_id in EXPERTS:
        if "XArm" not in gym_id or "RedOnTop" in gym_id:
            continue
        env = gym.make(gym_id, render_mode="rgb_array", disable_env_checker=True)
        env.reset(seed=SEED)
        demonstration = EXPERTS[gym_id](env, expert_generator(SEED))
        frames = film(env, demonstration.waypoints, demonstration.steps)
        save(frames, DOCS / "tasks" / f"{gym_id.removeprefix('hdp/').removesuffix('-v0')}.webp")


def film_planner(checkpoint: Path, prompt: str | None, seed: int) -> None:
    """A plan of a checkpoint, made around a prompt, into `docs/images/`."""
    subject = load(checkpoint, starts=1, first_seed=seed)
    plans = make_plans(subject, None if prompt is None else [prompt])
    env = gym.make(subject.gym_id, render_mode="rgb_array", disable_env_checker=True, **subject.parameters)
    env.reset(seed=seed)
    steps = plan_steps(plans.symbols[0], env.unwrapped.planning_task)
    save(film(env, plans.motions[0], steps), DOCS / "images" / f"{checkpoint.name}_plan.webp")


def plan_steps(symbols: list[str], task: PlanningTask) -> tuple[PlanStep, ...]:
    """The steps of a symbolic plan, at the time that all demonstrations of the task keep."""
    rows = plan_rows(len(symbols), task.horizon, task.step_ends)
    return tuple(PlanStep(tuple(symbols[row.tokens]), row.waypoints.stop) for row in rows if row.waypoints)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", nargs="?", type=Path, help="a `pretrained_model` folder; none: the experts")
    parser.add_argument("--prompt", help="a part of the plan")
    parser.add_argument("--seed", type=int, default=SEED, help="of the planner's start")
    options = parser.parse_args()
    if options.checkpoint is None:
        film_experts()
    else:
        film_planner(options.checkpoint, options.prompt, options.seed)


if __name__ == "__main__":
    main()
