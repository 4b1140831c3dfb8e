"""The planners that differ from HDP in how symbols are corrupted, and in what follows from it."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from ..configuration_hdp import HDPConfig


@PreTrainedConfig.register_subclass("diffuser")
@dataclass
class DiffuserConfig(HDPConfig):
    """Diffuser (Janner et al. 2022): models the motion alone, and needs no symbols in the dataset.

    The paper's version, like ours, models actions only (Janner et al. also the states between them), is conditioned on
    the observation by cross-attention (Janner et al. in-paint it), and is not guided by a value function.
    """

    symbol_process = None


@PreTrainedConfig.register_subclass("separate_diffuser")
@dataclass
class SeparateDiffuserConfig(HDPConfig):
    """Separate Diffuser: motion and one-hot symbols are two Gaussian processes with independent steps k_c and k_d.

    Attributes:
        symbol_loss_weight: weight of the symbols' mean squared error beside the motion's.
        symbol_lead: as in HDP, but 0 unless it is set.
    """

    symbol_process = "gaussian"

    symbol_loss_weight: float | None = 0.1
    symbol_lead: float | None = 0.0


@PreTrainedConfig.register_subclass("joint_diffuser")
@dataclass
class JointDiffuserConfig(SeparateDiffuserConfig):
    """Joint Diffuser: motion and one-hot symbols are one continuous variable, with one diffusion step k for both."""

    shared_level = True
