"""The robot half of every X-Arm task: waypoints in, physics, observations out.

A task adds its objects, says where they start, and scores where they end.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from .scene import BLOCK_HALF_SIZE, FRONT_CAMERA_FOVY, furnish
from .task import CAMERAS, FRONT_CAMERA, OBS_TYPES, RENDER_MODES, PlanningTask, check_image_size, parse_camera_names
from .waypoint_motion import WaypointMotion
from .xarm7 import ARM_JOINTS, GRIPPERS, ROBOT_CONTYPE, TCP_SITE, robot_spec

# All lengths in metres, in the robot's base frame: x forward, y left, z up from the table.
WORKSPACE_LOW = np.array([0.22, -0.34, 0.016])
WORKSPACE_HIGH = np.array([0.55, 0.34, 0.28])
"""Where the tool may go. The arm reaches every point of this box with the gripper down; below it the finger tips
would scrape the table."""
HOME = np.array([0.36, 0.0, 0.22])
"""Where the tool starts, give or take HOME_OFFSET along each axis."""
HOME_OFFSET = 0.03
REST_TOLERANCE = 0.005
"""A block whose centre is within this of BLOCK_HALF_SIZE above the table lies flat on it."""

RENDER_HEIGHT, RENDER_WIDTH = 480, 640
"""Size of `render()`'s image, in pixels."""

STATE_NAMES = ("x", "y", "z", "gripper")
POSE_NAMES = ("x", "y", "z", "qw", "qx", "qy", "qz")


class XArmEnv(gym.Env):
    """Base of the X-Arm tasks.

    Action (4,): a waypoint, x, y, z of the tool in metres in the base frame, and the gripper's opening in [0, 1]. The
    gripper points down. A step drives the arm there in one control period, 1 / `planning_task.fps` seconds.

    Observation, by `obs_type`: `state` has `agent_pos` (4,), the tool's measured position and opening, and
    `environment_state` (7 n,), x, y, z and a unit quaternion (w, x, y, z) of each object; `pixels` has a dictionary
    `pixels` of one (height, width, 3) uint8 image per camera; `pixels_agent_pos` has these and `agent_pos`;
    `pixels_state` has all three.

    An episode lasts `planning_task.horizon` steps. The reward is 0 until the last one, then the score in [0, 1];
    `info["is_success"]` says whether that is 1. `info["action_clipped"]` says that the waypoint lay outside the
    workspace, or too far to be reached in one step.

    Args:
        robot: one of `ROBOTS`.
        obs_type: one of `OBS_TYPES`.
        camera_name: the cameras to observe, from `CAMERAS`: `front,wrist`, or a sequence of names.
        observation_height: of an observed image, in pixels.
        observation_width: likewise.
        render_mode: None or `rgb_array`.

    Raises:
        ValueError: one of these has a value that it cannot have.
    """

    metadata = {"render_modes": list(RENDER_MODES)}  # noqa: RUF012 (gymnasium's own form)

    action_space: gym.spaces.Box
    object_names: tuple[str, ...]
    """The task's free bodies, in the order of `environment_state`."""
    camera_position = np.array([0.98, 0.0, 0.52])
    """Where the camera `front` is."""
    camera_target = np.array([0.37, 0.0, 0.05])
    """What it looks at."""

    def __init__(
        self,
        robot: str = "primitive",
        obs_type: str = "state",
        camera_name: str | Sequence[str] = CAMERAS,
        observation_height: int = 128,
        observation_width: int = 128,
        render_mode: str | None = None,
    ):
        if obs_type not in OBS_TYPES:
            raise ValueError(f"obs_type must be one of {tuple(OBS_TYPES)}, got {obs_type!r}")
        check_image_size(observation_height, observation_width)
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        self.planning_task = planning_task = self.facts(robot)
        self.metadata = {**self.metadata, "render_fps": planning_task.fps}
        self.render_mode = render_mode
        self.obs_type = obs_type
        self.camera_names = parse_camera_names(camera_name)
        self.camera_size = (observation_height, observation_width)

        spec = robot_spec(robot)
        robot_model = spec.compile()
        furnish(
            spec,
            self.camera_position,
            self.camera_target,
            image_height=max(observation_height, RENDER_HEIGHT),
            image_width=max(observation_width, RENDER_WIDTH),
        )
        self.add_objects(spec)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._tool = self.model.site(TCP_SITE).id
        self._gripper = GRIPPERS[robot]
        self._gripper_tendon = self.model.tendon(self._gripper.tendon).id
        self._arm_qpos = np.array([self.model.joint(name).qposadr[0] for name in ARM_JOINTS])
        self._object_qpos = np.array([self.model.joint(name).qposadr[0] + np.arange(7) for name in self.object_names])
        self._motion = WaypointMotion(robot_model, self._gripper, 1 / planning_task.fps, self.model.opt.timestep)
        self._renderers: dict[tuple[int, int], mujoco.Renderer] = {}

        self.action_space = gym.spaces.Box(
            np.array([*WORKSPACE_LOW, 0.0], np.float32), np.array([*WORKSPACE_HIGH, 1.0], np.float32)
        )
        self.observation_space = gym.spaces.Dict(self._observation_spaces())

        # LeRobot reads these three from every environment.
        self.task = planning_task.gym_id
        self.task_description = planning_task.instruction
        self._max_episode_steps = planning_task.horizon

    def __getstate__(self) -> dict[str, Any]:
        """For a copy, which makes renderers of its own."""
        return {**self.__dict__, "_renderers": {}}

    # What a task defines.

    @staticmethod
    def facts(robot: str) -> PlanningTask:
        """The task's facts, for one of `ROBOTS`."""
        raise NotImplementedError

    def add_objects(self, spec: mujoco.MjSpec) -> None:
        """Add the task's objects to the scene: a free body and joint for each of `object_names`."""
        raise NotImplementedError

    def draw_start(self, options: dict[str, Any]) -> np.ndarray:
        """Where each object starts, upright and square to the table, at random from `self.np_random`.

        Args:
            options: of `reset`.

        Returns:
            (n, 3) x, y, z of `object_names`, in metres.
        """
        raise NotImplementedError

    def score(self) -> float:
        """How much of the goal is reached, in [0, 1]."""
        raise NotImplementedError

    # gymnasium's contract.

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Start an episode: objects at random places, the tool near HOME, everything at rest.

        Args:
            seed: seeds the environment's random generator.
            options: what a task lets one fix; see its `draw_start`.

        Raises:
            ValueError: an option that the task knows has a value that it cannot have.
        """
        super().reset(seed=seed)
        start = self.draw_start(options or {})
        mujoco.mj_resetData(self.model, self.data)
        for name, place in zip(self.object_names, start, strict=True):
            self.set_object_pose(name, place)
        position = HOME + self.np_random.uniform(-HOME_OFFSET, HOME_OFFSET, size=3)
        self.data.qpos[self._arm_qpos] = self._motion.reset(np.array([*position, 1.0]))
        self.data.ctrl[:] = self._motion.hold()
        mujoco.mj_forward(self.model, self.data)
        self.elapsed_steps = 0
        return self._observation(), self._info(clipped=False)

    def step(self, action: np.ndarray):
        """Drive the arm to a waypoint.

        Raises:
            ValueError: the action has the wrong shape, or holds NaN or infinity.
        """
        controls, clipped = self.controls(action)
        for control in controls:
            self.data.ctrl[:] = control
            mujoco.mj_step(self.model, self.data)
        self.update_poses()

        self.elapsed_steps += 1
        truncated = self.elapsed_steps >= self.planning_task.horizon
        reward = self.score() if truncated else 0.0
        return self._observation(), reward, False, truncated, self._info(clipped)

    def render(self) -> np.ndarray:
        """The scene from the camera `front`: (480, 640, 3) uint8.

        Raises:
            OSError: there is nothing to render with.
        """
        return self._image(FRONT_CAMERA, RENDER_HEIGHT, RENDER_WIDTH, shadows=True)

    def close(self) -> None:
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()

    # What tasks, experts and tests use besides.

    def controls(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        """The actuator controls of one step; the commanded motion then stands at their end, and physics is to follow.

        Returns:
            (physics steps, actuators) controls, and whether the action was clipped.

        Raises:
            ValueError: the action has the wrong shape, or holds NaN or infinity.
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (4,) or not np.isfinite(action).all():
            raise ValueError(f"an action is 4 finite numbers (x, y, z, gripper), got {action.tolist()}")
        low, high = self.action_space.low, self.action_space.high
        outside = bool(((action < low - 1e-6) | (action > high + 1e-6)).any())
        controls, reached = self._motion.move_to(np.clip(action, low, high).astype(np.float64))
        return controls, outside or not reached

    def end_episode(self, clipped: bool) -> dict[str, Any]:
        """The last step's `info`, when the physics of an episode was run elsewhere and `data` holds its final state."""
        self.update_poses()
        self.elapsed_steps = self.planning_task.horizon
        return self._info(clipped)

    def update_poses(self) -> None:
        """Bring body poses and contacts up to date with the joint positions, which a physics step leaves behind."""
        mujoco.mj_fwdPosition(self.model, self.data)

    def tool_position(self) -> np.ndarray:
        """Measured x, y, z of the tool, in metres: (3,)."""
        return self.data.site_xpos[self._tool].copy()

    def gripper_opening(self) -> float:
        """Measured opening, in [0, 1]."""
        closed, opened = self._gripper.length
        length = self.data.ten_length[self._gripper_tendon]
        return float(np.clip((length - closed) / (opened - closed), 0.0, 1.0))

    def object_poses(self) -> np.ndarray:
        """x, y, z in metres and unit quaternion (w, x, y, z) of each object: (n, 7)."""
        return self.data.qpos[self._object_qpos]

    def set_object_pose(self, name: str, position: Sequence[float] | np.ndarray) -> None:
        """Put an object at x, y, z in metres, upright and square to the table."""
        self.data.joint(name).qpos[:] = (*position, 1, 0, 0, 0)

    def touched_by_robot(self, name: str) -> bool:
        """Whether any part of the robot touches an object."""
        pairs = self.data.contact.geom
        of_object = (self.model.geom_bodyid[pairs] == self.model.body(name).id).any(axis=1)
        return bool((self.model.geom_contype[pairs[of_object]] == ROBOT_CONTYPE).any())

    def lies_on_table(self, name: str) -> bool:
        """Whether a block of `add_block`, 4 cm high, lies flat on the table and the robot has let go of it."""
        height = self.data.body(name).xpos[2]
        return abs(height - BLOCK_HALF_SIZE) <= REST_TOLERANCE and not self.touched_by_robot(name)

    def world_to_pixels(self, points: np.ndarray) -> np.ndarray:
        """Pixel coordinates of points in the rendered image: (..., 3 or more) metres -> (..., 2) pixels."""
        camera = self.data.camera(FRONT_CAMERA)
        right, down, depth = np.moveaxis(
            (points[..., :3] - camera.xpos) @ camera.xmat.reshape(3, 3) * [1, -1, -1], -1, 0
        )
        focal_length = RENDER_HEIGHT / 2 / np.tan(np.deg2rad(FRONT_CAMERA_FOVY) / 2)
        return np.stack(
            [
                RENDER_WIDTH / 2 + focal_length * right / depth,
                RENDER_HEIGHT / 2 + focal_length * down / depth,
            ],
            axis=-1,
        )

    def _image(self, camera: str, height: int, width: int, shadows: bool) -> np.ndarray:
        if (height, width) not in self._renderers:
            try:
                self._renderers[height, width] = mujoco.Renderer(self.model, height, width)
            except (mujoco.FatalError, ImportError, AttributeError) as error:  # the last with MUJOCO_GL=disable
                raise OSError(
                    "cannot render images; without a display, MuJoCo needs EGL (Debian, Ubuntu: libegl1) and "
                    f"MUJOCO_GL=egl ({error})"
                ) from error
        renderer = self._renderers[height, width]
        renderer.update_scene(self.data, camera)
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        return renderer.render()

    def _observation_spaces(self) -> dict[str, gym.Space]:
        def unbounded(size: int) -> gym.spaces.Box:
            return gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)

        spaces: dict[str, gym.Space] = {}
        observed = OBS_TYPES[self.obs_type]
        if "agent_pos" in observed:
            spaces["agent_pos"] = unbounded(len(STATE_NAMES))
        if "environment_state" in observed:
            spaces["environment_state"] = unbounded(len(POSE_NAMES) * len(self.object_names))
        if "pixels" in observed:
            image = gym.spaces.Box(0, 255, (*self.camera_size, 3), np.uint8)
            spaces["pixels"] = gym.spaces.Dict(dict.fromkeys(self.camera_names, image))
        return spaces

    def _observation(self) -> dict[str, Any]:
        observation: dict[str, Any] = {}
        observed = OBS_TYPES[self.obs_type]
        if "agent_pos" in observed:
            agent_pos = [*self.tool_position(), self.gripper_opening()]
            observation["agent_pos"] = np.array(agent_pos, dtype=np.float32)
        if "environment_state" in observed:
            observation["environment_state"] = self.object_poses().flatten().astype(np.float32)
        if "pixels" in observed:
            # Without a GPU, shadows would take most of the time of an episode.
            observation["pixels"] = {
                name: self._image(name, *self.camera_size, shadows=False) for name in self.camera_names
            }
        return observation

    def _info(self, clipped: bool) -> dict[str, Any]:
        # LeRobot counts a success at any step, so there is none before the last.
        ended = self.elapsed_steps >= self.planning_task.horizon
        score = self.score()
        return {"is_success": ended and score == 1.0, "score": score, "action_clipped": clipped}


def pose_names(objects: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the components of `environment_state`: `A.x`, `A.y`, ..."""
    return tuple(f"{name}.{component}" for name in objects for component in POSE_NAMES)
