"""`--env.type=hdp`: LeRobot's view of the tasks."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from inspect import signature
from pkgutil import resolve_name
from typing import Any

from draccus.utils import ParsingError
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from .task import CAMERAS, OBS_TYPES, RENDER_MODES, ROBOTS, PlanningTask, check_image_size, parse_camera_names

TASKS = {
    "BlockSorting2D-v0": "gym_hdp_tasks.block_sorting_2d:block_sorting_2d_task",
    "XArmSorting-v0": "gym_hdp_tasks.xarm_sorting:xarm_sorting_task",
    "XArmArrangeBlocks-v0": "gym_hdp_tasks.xarm_arrange_blocks:xarm_arrange_blocks_task",
    "XArmToolUse-v0": "gym_hdp_tasks.xarm_tool_use:xarm_tool_use_task",
    "XArmToolUseRedOnTop-v0": "gym_hdp_tasks.xarm_tool_use:xarm_tool_use_red_on_top_task",
}
"""Task name, as in `--env.task=`, to the function that states the task's facts. It is imported when the task is chosen:
every command of LeRobot imports this module, also where there is no MuJoCo to be had."""
TASK_PARAMETERS = ("n_blocks", "waypoints_per_pose", "robot")
"""Fields of `HDPEnv` that a task has if the function that states its facts takes them."""
IMAGES_ONLY = ("camera_name", "observation_height", "observation_width")
XARM_ONLY = ("obs_type", *IMAGES_ONLY)
"""Fields of `HDPEnv` that tasks with a `robot` have; the cameras' mean something where images are observed."""


@EnvConfig.register_subclass("hdp")
@dataclass
class HDPEnv(EnvConfig):
    """Configuration of a task of this package.

    Attributes:
        task: one of `TASKS`.
        n_blocks: number of blocks (BlockSorting2D only).
        waypoints_per_pose: waypoints between two key poses of the expert, which sets the episode's length
            (BlockSorting2D only).
        robot: `primitive`, or `menagerie` for MuJoCo Menagerie's model (X-Arm tasks only).
        obs_type: `state`, `pixels`, `pixels_agent_pos` or `pixels_state` (X-Arm tasks only).
        camera_name: the cameras to observe: `front`, `wrist`, or `front,wrist` (X-Arm tasks only).
        observation_height: of an observed image, in pixels (X-Arm tasks only).
        observation_width: likewise.
        fps: actions per second, which the task decides.

    Raises:
        ParsingError: there is no such task, or it cannot have a value that is not the default.
    """

    task: str | None = "BlockSorting2D-v0"
    n_blocks: int = 3
    waypoints_per_pose: int = 3
    robot: str = "primitive"
    obs_type: str = "state"
    camera_name: str = ",".join(CAMERAS)
    observation_height: int = 128
    observation_width: int = 128
    fps: int = EnvConfig.fps
    render_mode: str = "rgb_array"

    def __post_init__(self):
        try:
            task = self.planning_task
            cameras = parse_camera_names(self.camera_name)
            check_image_size(self.observation_height, self.observation_width)
        except ValueError as error:  # LeRobot's commands show the message of draccus' own error only
            raise ParsingError(str(error)) from error
        for name, choices in (("robot", ROBOTS), ("obs_type", tuple(OBS_TYPES)), ("render_mode", RENDER_MODES)):
            if getattr(self, name) not in choices:
                raise ParsingError(f"--env.{name} must be one of {choices}, got {getattr(self, name)!r}")
        self.camera_name = ",".join(cameras)
        observed = OBS_TYPES[self.obs_type]
        others = set(TASK_PARAMETERS).difference(self._task_parameters) | set(() if self._has_robot else XARM_ONLY)
        for field in fields(self):
            if getattr(self, field.name) == field.default:
                continue
            if field.name in others:
                raise ParsingError(f"--env.{field.name} must be left out, {self.task} does not have it")
            if field.name in IMAGES_ONLY and "pixels" not in observed:
                advice = "add --env.obs_type=pixels, pixels_agent_pos or pixels_state"
                raise ParsingError(f"--env.{field.name} is of images: {advice}")
        if self.fps not in (EnvConfig.fps, task.fps):
            raise ParsingError(f"--env.fps must be left out, it is {task.fps} for {self.task}")
        self.fps = task.fps
        self.features = {ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(len(task.action_names),))}
        self.features_map = {ACTION: ACTION}
        if "agent_pos" in observed:
            self.features["agent_pos"] = PolicyFeature(type=FeatureType.STATE, shape=(len(task.state_names),))
            self.features_map["agent_pos"] = OBS_STATE
        if "environment_state" in observed:
            poses = PolicyFeature(type=FeatureType.ENV, shape=(len(task.environment_state_names),))
            self.features["environment_state"] = poses
            self.features_map["environment_state"] = OBS_ENV_STATE
        if "pixels" in observed:
            image = PolicyFeature(type=FeatureType.VISUAL, shape=(self.observation_height, self.observation_width, 3))
            self.features |= {f"pixels/{camera}": image for camera in cameras}
            self.features_map |= {f"pixels/{camera}": f"{OBS_IMAGES}.{camera}" for camera in cameras}

    def with_poses(self) -> "HDPEnv":
        """The same, where the objects' poses are observed, too: the task's checker of plans looks at them."""
        return self if "environment_state" in OBS_TYPES[self.obs_type] else replace(self, obs_type="pixels_state")

    @property
    def planning_task(self) -> PlanningTask:
        """The facts of the configured task.

        Raises:
            ValueError: there is no such task, or it cannot have these parameters.
        """
        return self._state_facts(**self._task_parameters)

    @property
    def _state_facts(self) -> Callable[..., PlanningTask]:
        if self.task not in TASKS:
            raise ValueError(f"--env.task={self.task} is not a task of --env.type=hdp; choose one of {list(TASKS)}")
        return resolve_name(TASKS[self.task])

    @property
    def _task_parameters(self) -> dict[str, Any]:
        taken = signature(self._state_facts).parameters
        return {name: getattr(self, name) for name in TASK_PARAMETERS if name in taken}

    @property
    def _has_robot(self) -> bool:
        return "robot" in self._task_parameters

    @property
    def package_name(self) -> str:
        return "gym_hdp_tasks"

    @property
    def gym_id(self) -> str:
        return f"hdp/{self.task}"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        kwargs = {"render_mode": self.render_mode, **self._task_parameters}
        if self._has_robot:
            kwargs |= {
                "obs_type": self.obs_type,
                "camera_name": self.camera_name,
                "observation_height": self.observation_height,
                "observation_width": self.observation_width,
            }
        return kwargs
