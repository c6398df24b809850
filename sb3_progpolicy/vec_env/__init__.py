"""Vectorised environments for any SB3 algorithm: batches of arrays, and environments shared out to a few processes."""

from sb3_progpolicy.vec_env.batched import BatchedVecEnv
from sb3_progpolicy.vec_env.factory import make_fast_vec_env
from sb3_progpolicy.vec_env.grouped import GroupedSubprocVecEnv, GroupedVecEnv
from sb3_progpolicy.vec_env.worker import WorkerDiedError

__all__ = ["BatchedVecEnv", "GroupedSubprocVecEnv", "GroupedVecEnv", "WorkerDiedError", "make_fast_vec_env"]
