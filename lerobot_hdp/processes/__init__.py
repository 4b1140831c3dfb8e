"""The diffusion processes: how a plan is corrupted, what is learned from that, and the way back."""

from .base import Corrupted, Process, SymbolProcess
from .gaussian import GaussianProcess
from .gaussian_symbols import GaussianSymbolProcess
from .masked import MaskedProcess

__all__ = ["Corrupted", "GaussianProcess", "GaussianSymbolProcess", "MaskedProcess", "Process", "SymbolProcess"]
