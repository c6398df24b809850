"""What takes the place of ``PPO`` and ``RecurrentPPO`` in the suites."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import sb3_contrib
import stable_baselines3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_progpolicy import ProgrammaticPolicy, RecurrentProgrammaticPolicy, ReptilePPO

#: The names of networks that the suites ask for.
NETWORKS = tuple(f"{reads}{state}Policy" for reads in ("Mlp", "Cnn", "MultiInput") for state in ("", "Lstm"))


def aliases(policy: type[BasePolicy]) -> dict[str, type[BasePolicy]]:
    """Return the table that gives one policy whichever network is asked for."""
    return dict.fromkeys(NETWORKS, policy)


class OneEnvironment(ReptilePPO):
    """``ReptilePPO`` with one environment for an id, as SB3's algorithms have, and defaults to replace its own."""

    defaults: ClassVar[Mapping[str, Any]] = {}

    def __init__(self, policy: Any, env: Any, *args: Any, **kwargs: Any) -> None:
        if isinstance(env, str):
            kwargs.setdefault("n_envs", 1)
        super().__init__(policy, env, *args, **{**self.defaults, **kwargs})


class ReptileMlp(OneEnvironment):
    defaults = {"interaction_history": False}
    policy_aliases = stable_baselines3.PPO.policy_aliases


class ReptileMlpLstm(OneEnvironment):
    defaults = {"interaction_history": False}
    policy_aliases = sb3_contrib.RecurrentPPO.policy_aliases


class ReptileProg(OneEnvironment):
    policy_aliases = aliases(RecurrentProgrammaticPolicy)


class ReptileProgWithoutHistory(ReptileProg):
    defaults = {"interaction_history": False}


class ReptilePRL(OneEnvironment):
    policy_aliases = aliases(ProgrammaticPolicy)


class PRL(stable_baselines3.PPO):
    policy_aliases = aliases(ProgrammaticPolicy)


class Prog(sb3_contrib.RecurrentPPO):
    policy_aliases = aliases(RecurrentProgrammaticPolicy)


@dataclass(frozen=True)
class Variant:
    """A suite with an algorithm of its package replaced.

    :param package: whose suite it is
    :param replaced: the algorithm's name in the package
    :param by: what the tests get instead
    """

    package: str
    replaced: str
    by: type[BaseAlgorithm]


SB3, CONTRIB = "stable_baselines3", "sb3_contrib"
VARIANTS: Mapping[str, Variant] = {
    "PPO": Variant(SB3, "PPO", stable_baselines3.PPO),
    "ReptilePPO, MlpPolicy, no history": Variant(SB3, "PPO", ReptileMlp),
    "ReptilePPO, ProgPolicy": Variant(SB3, "PPO", ReptileProg),
    "ReptilePPO, ProgPolicy, no history": Variant(SB3, "PPO", ReptileProgWithoutHistory),
    "ReptilePPO, PRLPolicy": Variant(SB3, "PPO", ReptilePRL),
    "PPO, PRLPolicy": Variant(SB3, "PPO", PRL),
    "RecurrentPPO": Variant(CONTRIB, "RecurrentPPO", sb3_contrib.RecurrentPPO),
    "RecurrentPPO, ProgPolicy": Variant(CONTRIB, "RecurrentPPO", Prog),
    "ReptilePPO, MlpLstmPolicy, no history": Variant(CONTRIB, "RecurrentPPO", ReptileMlpLstm),
    "ReptilePPO, ProgPolicy (contrib)": Variant(CONTRIB, "RecurrentPPO", ReptileProg),
}
