"""The diffusion processes: how a plan is corrupted, what is learned from that, and the way back."""

from .base import Corrupted, Process
from .gaussian import GaussianProcess
from .masked import MaskedProcess

__all__ = ["Corrupted", "GaussianProcess", "MaskedProcess", "Process"]
