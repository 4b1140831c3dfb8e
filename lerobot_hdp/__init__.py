"""Hybrid Diffusion Planning: denoise a robot motion and the symbolic plan behind it at once."""

from .configuration_hdp import HDPConfig
from .plan import Plan, PlanPrompt
from .vocabulary import FREE, Vocabulary

__all__ = ["FREE", "HDPConfig", "Plan", "PlanPrompt", "Vocabulary"]
