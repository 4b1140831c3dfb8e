"""The xArm7 with a parallel gripper, as an `MjSpec` to put a scene around.

Two models answer to the same names: joints `joint1` ... `joint7` and their actuators `act1` ... `act7`, the site `tcp`
midway between the pads, the camera `wrist`, and the geoms `left_pad` and `right_pad`. `GRIPPERS` says how each opens.
"""

from dataclasses import dataclass
from pathlib import Path

import mujoco

from .task import ROBOTS, WRIST_CAMERA

ARM_JOINTS = tuple(f"joint{i}" for i in range(1, 8))
HOME_JOINTS = (0.0, -0.247, 0.0, 0.909, 0.0, 1.15644, 0.0)
"""In radians: the gripper points down, in front of the base."""
MAX_JOINT_SPEED = 3.14
"""In rad/s, the real arm's limit (180 degrees per second) for each joint."""
ROBOT_CONTYPE = 2
"""Contact type of the robot's geoms: they meet the scene's geoms, never each other."""
TCP_SITE = "tcp"

_PRIMITIVE_XML = Path(__file__).parent / "assets" / "xarm7.xml"
_ARMATURE = (0.5, 0.5, 0.3, 0.3, 0.3, 0.2, 0.2)
"""Inertia of the joints' motors and gears in kg m^2; `assets/xarm7.xml` says why."""
_STIFFNESS_SCALE, _DAMPING_SCALE = 2.0, 0.5
"""What the servos' gains are multiplied by, as in `assets/xarm7.xml`, for an arm that settles sooner."""
_MENAGERIE_PAD_OFFSET = 0.0237
"""In metres, from a finger's frame inwards to the middle of the pad."""
_MENAGERIE_TCP_DEPTH = 0.155
"""In metres, from the gripper's base to between the pads when they hold a block; Menagerie's own `link_tcp` (0.172)
lies beyond their ends."""
_MENAGERIE_GRIPPER_FORCE = 1.2
"""On the tendon: about 10 N at a pad. The full 50 squeezes a light block out sideways."""


@dataclass(frozen=True)
class Gripper:
    """How an opening in [0, 1] maps to a model's tendon and actuator: the values when closed and when open.

    Both models are open at joint position 0.
    """

    tendon: str
    actuator: str
    length: tuple[float, float]
    control: tuple[float, float]


GRIPPERS = {
    "primitive": Gripper("gripper", "gripper", length=(0.085, 0.0), control=(0.085, 0.0)),
    "menagerie": Gripper("split", "gripper", length=(0.85, 0.0), control=(255.0, 0.0)),
}


def robot_spec(robot: str = "primitive") -> mujoco.MjSpec:
    """The arm on a base at the origin, gravity compensated within its torque limits.

    Raises:
        ValueError: `robot` is not one of `ROBOTS`.
        ImportError: `menagerie` without the package `mujoco-menagerie`.
        OSError: `menagerie`, and its model cannot be downloaded, or is not in the folder `MENAGERIE_ROOT`.
    """
    if robot not in ROBOTS:
        raise ValueError(f"robot must be one of {ROBOTS}, got {robot!r}")
    spec = mujoco.MjSpec.from_file(str(_PRIMITIVE_XML)) if robot == "primitive" else _menagerie_spec()
    for body in spec.bodies:
        body.gravcomp = 1.0
    for name in ARM_JOINTS:
        # Compensation is the motors' work, so that it counts against their torque limit.
        spec.joint(name).actgravcomp = True
    return spec


def _menagerie_spec() -> mujoco.MjSpec:
    try:
        import mujoco_menagerie
    except ImportError as error:
        raise ImportError("robot='menagerie' needs mujoco-menagerie, this package's extra `menagerie`") from error
    try:
        spec = mujoco_menagerie.get("ufactory_xarm7").spec("xarm7")
    except mujoco_menagerie.MenagerieError as error:
        raise OSError(
            "cannot load the model of robot='menagerie', which is downloaded on first use or read from the folder "
            f"MENAGERIE_ROOT: {error}"
        ) from error
    spec.body("link_base").pos = (0, 0, 0)
    for name, armature in zip(ARM_JOINTS, _ARMATURE, strict=True):
        joint, actuator = spec.joint(name), spec.actuator(name.replace("joint", "act"))
        joint.armature = armature
        joint.actfrcrange = actuator.forcerange
        gain, bias = actuator.gainprm.copy(), actuator.biasprm.copy()
        gain[0] *= _STIFFNESS_SCALE
        bias[1:3] *= _STIFFNESS_SCALE, _DAMPING_SCALE
        actuator.gainprm, actuator.biasprm = gain, bias
    for joint in spec.joints:
        joint.frictionloss = 0.0
    spec.actuator("gripper").forcerange = (-_MENAGERIE_GRIPPER_FORCE, _MENAGERIE_GRIPPER_FORCE)
    for geom in spec.geoms:
        geom.contype, geom.conaffinity = ROBOT_CONTYPE, 0
    _add_menagerie_pads(spec)

    hand = spec.body("xarm_gripper_base_link")
    hand.add_site(name=TCP_SITE, pos=(0, 0, _MENAGERIE_TCP_DEPTH))
    hand.add_camera(name=WRIST_CAMERA, pos=(0.06, 0, 0.08), quat=(0.1221, -0.6965, 0.6965, -0.1221), fovy=85)
    return spec


def _add_menagerie_pads(spec: mujoco.MjSpec) -> None:
    """Menagerie's fingers collide as convex hulls of their meshes; a box on each, 0.5 mm proud, takes the grip."""
    for finger, inward in (("left_finger", -1), ("right_finger", 1)):
        spec.body(finger).add_geom(
            name=finger.replace("finger", "pad"),
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=(0.014, 0.003, 0.017),
            pos=(0, inward * _MENAGERIE_PAD_OFFSET, 0.042),
            rgba=(0.25, 0.25, 0.27, 1),
            contype=ROBOT_CONTYPE,
            conaffinity=0,
            priority=1,
            friction=(1.5, 0.02, 0.0001),
            solref=(0.007, 1),
            solimp=(0.98, 0.99, 0.001, 0.5, 2),
            mass=0,
        )
