"""Reptile: the tasks, the two steps of a meta-iteration, a callback for stock algorithms, checkpoints."""

from sb3_progpolicy.reptile.callback import ReptileWrapper
from sb3_progpolicy.reptile.checkpoint import ReptileCheckpoint, load_last_good
from sb3_progpolicy.reptile.tasks import RemakeOnVariation, TaskDistribution

__all__ = ["RemakeOnVariation", "ReptileCheckpoint", "ReptileWrapper", "TaskDistribution", "load_last_good"]
