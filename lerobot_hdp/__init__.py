"""Hybrid Diffusion Planning: denoise a robot motion and the symbolic plan behind it at once."""

from .configuration_hdp import HDPConfig
from .plan import Plan, PlanPrompt
from .vocabulary import FREE, FREE_SYMBOL, Vocabulary

__all__ = ["FREE", "FREE_SYMBOL", "HDPConfig", "Plan", "PlanPrompt", "Vocabulary"]
