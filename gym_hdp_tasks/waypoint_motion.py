"""From waypoints to actuator controls: inverse kinematics, and a smooth joint motion in between.

The controls depend on the waypoints alone, never on the simulated state, so that those of a whole plan can be known
before its physics is run (`open_loop.py`).
"""

import mink
import mujoco
import numpy as np

from .xarm7 import ARM_JOINTS, HOME_JOINTS, MAX_JOINT_SPEED, TCP_SITE, Gripper

SETTLE_TIME = 0.08
"""In seconds, at the end of each control period: the command stands still and the arm comes to rest."""

_POSITION_TOLERANCE, _ROTATION_TOLERANCE = 1e-4, 1e-3
"""Inverse kinematics is solved to within these: metres, radians."""
_MAX_ITERATIONS = 20
_ROTATION_COST = 0.3
"""In metres per radian: a rotation error of 1 rad weighs as much as this position error."""
_DAMPING = 1e-6
_GRIPPER_DOWN = mink.SO3.from_matrix(np.diag([-1.0, 1.0, -1.0]))
"""Rotation of the site `tcp`: it points down, and the fingers open along the table's y axis."""


class WaypointMotion:
    """Turns waypoints into actuator controls, one control period at a time.

    Between two waypoints the tool is commanded to move straight and to rest at each end: a parabola in joint space,
    through the inverse kinematics of the half-way point, keeps within 3 mm of the line over 20 cm. Where that would
    exceed the joints' speed limit, the command stops short on the line. The arm follows as far as its torque limits,
    which are not looked at here, allow.

    Args:
        robot_model: the robot alone, for kinematics.
        gripper: how its gripper is commanded.
        control_period: time for one waypoint, in seconds.
        timestep: time for one control, in seconds.
    """

    def __init__(self, robot_model: mujoco.MjModel, gripper: Gripper, control_period: float, timestep: float):
        self._gripper = gripper
        self._arm_qpos = np.array([robot_model.joint(name).qposadr[0] for name in ARM_JOINTS])
        actuators = [robot_model.actuator(name.replace("joint", "act")).id for name in ARM_JOINTS]
        self._arm_actuators = np.array(actuators)
        self._gripper_actuator = robot_model.actuator(gripper.actuator).id
        self._n_actuators = robot_model.nu

        self._home = robot_model.qpos0.copy()
        self._home[self._arm_qpos] = HOME_JOINTS

        # A servo with gain kp and damping kv follows a constant speed with this delay, in s, and a constant
        # acceleration with this lag, in s^2; commanding the position that far ahead cancels both.
        dofs = [robot_model.joint(name).dofadr[0] for name in ARM_JOINTS]
        kp, kv = robot_model.actuator_gainprm[actuators, 0], -robot_model.actuator_biasprm[actuators, 2]
        self._delay = (kv + robot_model.dof_damping[dofs]) / kp
        self._lag = _joint_inertias(robot_model, self._home)[dofs] / kp

        n_controls = round(control_period / timestep)
        self._move_time = control_period - SETTLE_TIME
        time = np.minimum(timestep * np.arange(1, n_controls + 1) / self._move_time, 1.0)
        self._progress = (3 * time**2 - 2 * time**3)[:, None]
        self._progress_rate = (6 * time * (1 - time) / self._move_time)[:, None]
        self._progress_acceleration = ((6 - 12 * time) * (time < 1) / self._move_time**2)[:, None]

        self._configuration = mink.Configuration(robot_model)
        self._tool = mink.FrameTask(TCP_SITE, "site", position_cost=1.0, orientation_cost=_ROTATION_COST)
        # With the gripper pointing down, joints 3 and 5 at 0 leave exactly one solution to the other five.
        # The gripper's own joints do not matter; a cost on them keeps them where they are.
        cost = np.ones(robot_model.nv)
        cost[np.delete(dofs, [2, 4])] = 0.0
        self._posture = mink.PostureTask(robot_model, cost=cost)
        self._posture.set_target(robot_model.qpos0)
        self._limits = [mink.ConfigurationLimit(robot_model)]

    def reset(self, waypoint: np.ndarray) -> np.ndarray:
        """Start from rest at a waypoint: (4,) x, y, z in metres and opening -> (7,) joint angles in radians."""
        self._configuration.update(self._home)
        self._waypoint = np.array(waypoint, dtype=np.float64)
        self._joints, _ = self._inverse_kinematics(self._waypoint[:3])
        return self._joints

    def hold(self) -> np.ndarray:
        """The control that stays where the motion is: (number of actuators,)."""
        return self._controls(self._joints[None], np.array([self._waypoint[3]]))[0]

    def move_to(self, waypoint: np.ndarray) -> tuple[np.ndarray, bool]:
        """Controls for the next control period.

        Args:
            waypoint: (4,) x, y, z in metres, inside the reachable workspace, and opening in [0, 1].

        Returns:
            (number of timesteps, number of actuators) controls, and whether the motion gets to the waypoint within
            the speed limits.
        """
        start, start_joints = self._waypoint, self._joints
        middle_joints, _ = self._inverse_kinematics((start[:3] + waypoint[:3]) / 2)
        end_joints, solved = self._inverse_kinematics(waypoint[:3])

        # q(s) = start + slope s + curvature s^2 goes through the three joint positions at s = 0, 1/2, 1.
        curvature = 2 * (start_joints + end_joints - 2 * middle_joints)
        slope = end_joints - start_joints - curvature
        peak_speed = np.abs((slope + 2 * curvature * self._progress) * self._progress_rate).max()
        reached = 1.0
        if peak_speed > MAX_JOINT_SPEED:  # on a shorter way the direction peaks elsewhere: the bound for all of them
            bound = 1.5 * np.maximum(np.abs(slope), np.abs(slope + 2 * curvature)).max() / self._move_time
            reached = min(1.0, MAX_JOINT_SPEED / bound)

        s, rate = reached * self._progress, reached * self._progress_rate
        joints = start_joints + slope * s + curvature * s**2
        direction = slope + 2 * curvature * s
        speeds = direction * rate
        accelerations = direction * reached * self._progress_acceleration + 2 * curvature * rate**2
        openings = start[3] + (waypoint[3] - start[3]) * self._progress[:, 0]
        controls = self._controls(joints + self._delay * speeds + self._lag * accelerations, openings)

        self._joints = joints[-1]
        self._waypoint = np.append(start[:3] + reached * (waypoint[:3] - start[:3]), waypoint[3])
        if reached < 1:  # the next inverse kinematics starts where the arm is, not where it should have been
            stopped = self._configuration.q.copy()
            stopped[self._arm_qpos] = self._joints
            self._configuration.update(stopped)
        return controls, solved and reached == 1.0

    def _controls(self, joints: np.ndarray, openings: np.ndarray) -> np.ndarray:
        controls = np.zeros((len(joints), self._n_actuators))
        controls[:, self._arm_actuators] = joints
        closed, opened = self._gripper.control
        controls[:, self._gripper_actuator] = closed + (opened - closed) * openings
        return controls

    def _inverse_kinematics(self, position: np.ndarray) -> tuple[np.ndarray, bool]:
        """Joint angles (7,) that bring the tool to a position (3,), from the last ones on, and whether they do."""
        self._tool.set_target(mink.SE3.from_rotation_and_translation(_GRIPPER_DOWN, position))
        for _ in range(_MAX_ITERATIONS):
            error = self._tool.compute_error(self._configuration)
            if np.linalg.norm(error[:3]) < _POSITION_TOLERANCE and np.linalg.norm(error[3:]) < _ROTATION_TOLERANCE:
                return self._configuration.q[self._arm_qpos].copy(), True
            velocity = mink.solve_ik(
                self._configuration,
                [self._tool, self._posture],
                dt=1.0,
                solver="daqp",
                damping=_DAMPING,
                limits=self._limits,
            )
            self._configuration.integrate_inplace(velocity, 1.0)
        return self._configuration.q[self._arm_qpos].copy(), False


def _joint_inertias(model: mujoco.MjModel, configuration: np.ndarray) -> np.ndarray:
    """Inertia that each joint feels when it moves alone, at a configuration: (nv,) in kg m^2."""
    data = mujoco.MjData(model)
    data.qpos[:] = configuration
    mujoco.mj_forward(model, data)
    inertia = np.empty((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    return inertia.diagonal().copy()
