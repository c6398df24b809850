"""Learn a readable program instead of a black box: programmatic policies and Reptile for Stable-Baselines3."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import progpolicy_envs  # registers the environments

if TYPE_CHECKING:
    from sb3_progpolicy.analysis.simplify import Simplification, simplify
    from sb3_progpolicy.analysis.verify import Verification, verify
    from sb3_progpolicy.baselines import HIRO, DiscreteSAC
    from sb3_progpolicy.callbacks import InteractionEvalCallback
    from sb3_progpolicy.evaluation import Evaluation, evaluate_model, evaluate_program
    from sb3_progpolicy.extraction import extract_program, holds_program
    from sb3_progpolicy.imitation import compare_with_teacher, imitate
    from sb3_progpolicy.interaction import InteractionHistory, VecInteractionHistory
    from sb3_progpolicy.policies import ProgrammaticPolicy, RecurrentProgrammaticPolicy
    from sb3_progpolicy.pretrained import load_pretrained, pretrained_names
    from sb3_progpolicy.reptile.callback import ReptileWrapper
    from sb3_progpolicy.reptile.checkpoint import ReptileCheckpoint, load_last_good
    from sb3_progpolicy.reptile.tasks import RemakeOnVariation, TaskDistribution
    from sb3_progpolicy.reptile_ppo import ReptilePPO
    from sb3_progpolicy.vec_env import BatchedVecEnv, GroupedSubprocVecEnv, GroupedVecEnv, make_fast_vec_env

# Modules are imported when a name is first used: reading and running a program needs no torch.
_MODULES = {
    "HIRO": "baselines",
    "BatchedVecEnv": "vec_env",
    "DiscreteSAC": "baselines",
    "Evaluation": "evaluation",
    "GroupedSubprocVecEnv": "vec_env",
    "GroupedVecEnv": "vec_env",
    "InteractionEvalCallback": "callbacks",
    "InteractionHistory": "interaction",
    "ProgrammaticPolicy": "policies",
    "RecurrentProgrammaticPolicy": "policies",
    "RemakeOnVariation": "reptile",
    "ReptileCheckpoint": "reptile",
    "ReptilePPO": "reptile_ppo",
    "ReptileWrapper": "reptile",
    "Simplification": "analysis.simplify",
    "TaskDistribution": "reptile",
    "VecInteractionHistory": "interaction",
    "Verification": "analysis.verify",
    "compare_with_teacher": "imitation",
    "evaluate_model": "evaluation",
    "evaluate_program": "evaluation",
    "extract_program": "extraction",
    "holds_program": "extraction",
    "imitate": "imitation",
    "load_last_good": "reptile",
    "load_pretrained": "pretrained",
    "make_fast_vec_env": "vec_env",
    "pretrained_names": "pretrained",
    "simplify": "analysis.simplify",
    "verify": "analysis.verify",
}

__all__ = [
    "HIRO",
    "BatchedVecEnv",
    "DiscreteSAC",
    "Evaluation",
    "GroupedSubprocVecEnv",
    "GroupedVecEnv",
    "InteractionEvalCallback",
    "InteractionHistory",
    "ProgrammaticPolicy",
    "RecurrentProgrammaticPolicy",
    "RemakeOnVariation",
    "ReptileCheckpoint",
    "ReptilePPO",
    "ReptileWrapper",
    "Simplification",
    "TaskDistribution",
    "VecInteractionHistory",
    "Verification",
    "compare_with_teacher",
    "evaluate_model",
    "evaluate_program",
    "extract_program",
    "holds_program",
    "imitate",
    "load_last_good",
    "load_pretrained",
    "make_fast_vec_env",
    "pretrained_names",
    "progpolicy_envs",
    "simplify",
    "verify",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
