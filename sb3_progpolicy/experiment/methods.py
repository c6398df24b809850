"""The registry: what each method is. Command line, training, tuning, benchmark, zoo and documentation read it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from gymnasium import spaces
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_progpolicy.baselines import HIRO, DiscreteSAC
from sb3_progpolicy.nearest import unknown
from sb3_progpolicy.policies import ProgrammaticPolicy, RecurrentProgrammaticPolicy
from sb3_progpolicy.reptile_ppo.algorithm import ReptilePPO


@dataclass(frozen=True)
class Method:
    """One method that can be trained and compared.

    :param name: as given to ``progpolicy train --algo``, and of its file in ``sb3_progpolicy/hyperparams``
    :param description: what it is, in a few words
    :param source: where it comes from
    :param algorithm: the SB3 algorithm; several methods may share one
    :param policy: its usual policy
    :param across_variations: whether it trains across a domain's training variations, or on the environment as it is
    :param compared: whether it is one of the nine methods of the comparison
    :param discrete: what takes the algorithm's place where actions are ``Discrete``
    :param policies: policies of this package that the algorithm accepts besides its own, by alias
    """

    name: str
    description: str
    source: str
    algorithm: type[BaseAlgorithm]
    policy: str
    across_variations: bool
    compared: bool = True
    discrete: type[BaseAlgorithm] | None = None
    policies: Mapping[str, type[BasePolicy]] = field(default_factory=dict)

    @property
    def has_reptile(self) -> bool:
        """Whether the algorithm draws tasks and makes meta-steps by itself.

        Such an algorithm makes its environments from an id, and its runs can be resumed.
        """
        return hasattr(self.algorithm, "inner_loop")

    @property
    def takes_tasks(self) -> bool:
        """Whether it can train across variations: by itself, or by a :class:`~sb3_progpolicy.ReptileWrapper`."""
        return issubclass(self.algorithm, OnPolicyAlgorithm)

    @property
    def all_policies(self) -> dict[str, type[BasePolicy]]:
        """Every policy that the algorithm accepts, by alias."""
        return {**self.algorithm.policy_aliases, **self.policies}

    def algorithm_for(self, action_space: spaces.Space[Any]) -> type[BaseAlgorithm]:
        """Return the algorithm for an action space.

        :param action_space: of the environment
        """
        if self.discrete is not None and isinstance(action_space, spaces.Discrete):
            return self.discrete
        return self.algorithm


METHODS: Mapping[str, Method] = MappingProxyType(
    {
        method.name: method
        for method in (
            Method(
                name="reptile_ppo",
                description="a program with recurrent conditions, Reptile across variations (algorithm 1)",
                source="Wu et al., IJCAI 2024",
                algorithm=ReptilePPO,
                policy="ProgPolicy",
                across_variations=True,
            ),
            Method(
                name="ppo_n",
                description="the same loop with the meta-update left out",
                source="Wu et al., IJCAI 2024, section 3 (PPO-N)",
                algorithm=ReptilePPO,
                policy="ProgPolicy",
                across_variations=True,
            ),
            Method(
                name="reptile_prl",
                description="a program with affine conditions, Reptile across variations",
                source="Wu et al., IJCAI 2024, section 3 (ReptilePRL)",
                algorithm=ReptilePPO,
                policy="PRLPolicy",
                across_variations=True,
            ),
            Method(
                name="reptile_mlp",
                description="a network, Reptile across variations: what the paper calls ReptilePPO",
                source="Nichol and Schulman, arXiv:1803.02999; Wu et al., IJCAI 2024, section 3",
                algorithm=ReptilePPO,
                policy="MlpPolicy",
                across_variations=True,
            ),
            Method(
                name="prl",
                description="a program with affine conditions and architecture search, on one fixed variation",
                source="Qiu and Zhu, ICLR 2022",
                algorithm=ReptilePPO,
                policy="PRLPolicy",
                across_variations=False,
            ),
            Method(
                name="ppo",
                description="SB3's PPO, a network on one fixed variation",
                source="Schulman et al., arXiv:1707.06347",
                algorithm=PPO,
                policy="MlpPolicy",
                across_variations=False,
                policies={"PRLPolicy": ProgrammaticPolicy},
            ),
            Method(
                name="sac",
                description="SB3's SAC, or DiscreteSAC where actions are Discrete, on one fixed variation",
                source="Haarnoja et al., arXiv:1801.01290; Christodoulou, arXiv:1910.07207",
                algorithm=SAC,
                policy="MlpPolicy",
                across_variations=False,
                discrete=DiscreteSAC,
            ),
            Method(
                name="hiro",
                description="two levels of off-policy learning, goals every few steps, on one fixed variation",
                source="Nachum et al., arXiv:1805.08296",
                algorithm=HIRO,
                policy="MlpPolicy",
                across_variations=False,
            ),
            Method(
                name="recurrent_ppo_multitask",
                description="sb3-contrib's RecurrentPPO on the same mix of tasks with the same input",
                source="the neural baseline of arXiv:2506.14162; sb3-contrib",
                algorithm=RecurrentPPO,
                policy="MlpLstmPolicy",
                across_variations=True,
                policies={"ProgPolicy": RecurrentProgrammaticPolicy},
            ),
            Method(
                name="recurrent_ppo",
                description="sb3-contrib's RecurrentPPO on one fixed variation",
                source="sb3-contrib; Schulman et al., arXiv:1707.06347",
                algorithm=RecurrentPPO,
                policy="MlpLstmPolicy",
                across_variations=False,
                compared=False,
                policies={"ProgPolicy": RecurrentProgrammaticPolicy},
            ),
        )
    }
)


def get_method(name: str) -> Method:
    """Return a method.

    :param name: a key of :data:`METHODS`
    :raises ValueError: if there is none of that name; the message names the nearest ones
    """
    if name not in METHODS:
        raise unknown("algorithm", name, METHODS)
    return METHODS[name]
