"""What stands around the robot: table, light, camera, blocks and slots. Lengths in metres."""

import mujoco
import numpy as np

from .task import FRONT_CAMERA

BLOCK_HALF_SIZE = 0.02
BLOCK_MASS = 0.05
"""In kilograms."""
FRONT_CAMERA_FOVY = 42.0
"""In degrees, of the image's height."""

RED, GREEN, BLUE = (0.84, 0.24, 0.22), (0.18, 0.62, 0.36), (0.20, 0.46, 0.82)
GREY = (0.55, 0.55, 0.57)

_MATTE = "matte"
_TIMESTEP = 1 / 300
"""In seconds: control periods of 1 s and 1/3 s are whole multiples."""


def furnish(
    spec: mujoco.MjSpec, camera_position: np.ndarray, camera_target: np.ndarray, image_height: int, image_width: int
) -> None:
    """Put the table under the robot, and light and the front camera before it.

    Args:
        spec: the robot.
        camera_position: (3,) of the front camera.
        camera_target: (3,) what it looks at.
        image_height: of the largest image that will be rendered, in pixels.
        image_width: likewise.
    """
    spec.option.timestep = _TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # What MuJoCo's documentation advises against slip in a grasp.
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10
    spec.visual.global_.offheight = image_height
    spec.visual.global_.offwidth = image_width
    spec.visual.quality.shadowsize = 2048
    spec.visual.headlight.ambient = (0.30, 0.30, 0.30)
    spec.visual.headlight.diffuse = (0.25, 0.25, 0.25)
    spec.visual.headlight.specular = (0.1, 0.1, 0.1)

    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.93, 0.95, 0.97),
        rgb2=(0.70, 0.76, 0.83),
        width=128,
        height=768,
    )
    spec.add_material(name=_MATTE, specular=0, shininess=0)
    world = spec.worldbody
    world.add_light(pos=(0.9, 0.3, 1.8), dir=(-0.3, -0.15, -1), diffuse=(0.45, 0.45, 0.45), castshadow=True)
    world.add_light(pos=(0.6, -0.8, 1.5), dir=(-0.1, 0.5, -1), diffuse=(0.35, 0.35, 0.35), castshadow=False)
    # The plane is drawn as a table top and collides without end: nothing can fall off.
    world.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(1.2, 1.2, 0.1),
        material=_MATTE,
        rgba=(0.80, 0.77, 0.72, 1),
        contype=1,
        conaffinity=3,
        friction=(0.6, 0.005, 0.0001),
    )
    world.add_camera(
        name=FRONT_CAMERA,
        pos=camera_position,
        quat=_look_at(camera_position, camera_target),
        fovy=FRONT_CAMERA_FOVY,
    )


def add_block(spec: mujoco.MjSpec, name: str, colour: tuple[float, float, float]) -> None:
    """A free cube."""
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[BLOCK_HALF_SIZE] * 3,
        mass=BLOCK_MASS,
        rgba=(*colour, 1),
        contype=1,
        conaffinity=3,
        friction=(0.6, 0.005, 0.0001),
    )


def add_slot(spec: mujoco.MjSpec, centre: np.ndarray, half_size: float, colour: tuple[float, float, float]) -> None:
    """A square painted on the table: a frame around a lighter field, which nothing collides with."""
    tint = 1 - 0.45 * (1 - np.array(colour))
    for size, height, rgb in ((half_size, 0.0004, colour), (half_size - 0.004, 0.0008, tint)):
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=(size, size, height / 2),
            pos=(*centre, height / 2),
            material=_MATTE,
            rgba=(*rgb, 1),
            contype=0,
            conaffinity=0,
        )


def _look_at(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Orientation of a camera at `position` that looks at `target`, upright: unit quaternion (w, x, y, z)."""
    backward = (position - target) / np.linalg.norm(position - target)
    right = np.cross([0, 0, 1], backward)
    right /= np.linalg.norm(right)
    rotation = np.column_stack([right, np.cross(backward, right), backward])
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, rotation.flatten())
    return quaternion
