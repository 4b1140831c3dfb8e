"""LeRobot finds a policy's class by the name and the module of its configuration: what differs is said there."""

from ..modeling_hdp import HDPPolicy
from .configuration_ablations import DiffuserConfig, JointDiffuserConfig, SeparateDiffuserConfig


class DiffuserPolicy(HDPPolicy):
    config_class = DiffuserConfig
    name = "diffuser"


class JointDiffuserPolicy(HDPPolicy):
    config_class = JointDiffuserConfig
    name = "joint_diffuser"
    can_score = False


class SeparateDiffuserPolicy(HDPPolicy):
    config_class = SeparateDiffuserConfig
    name = "separate_diffuser"
    can_score = False
