"""The registry: what each method is. Command line, training, evaluation, zoo and documentation read it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_progpolicy.nearest import unknown
from sb3_progpolicy.policies import ProgrammaticPolicy, RecurrentProgrammaticPolicy
from sb3_progpolicy.reptile_ppo.algorithm import ReptilePPO


@dataclass(frozen=True)
class Method:
    """One method that can be trained and compared.

    :param name: as given to ``progpolicy train --algo``
    :param algorithm: the SB3 algorithm; several methods may share one
    :param policy: its usual policy
    :param hyperparams: name of its file in ``sb3_progpolicy/hyperparams``
    :param across_variations: whether it trains across a domain's training variations, or on the environment as it is
    :param has_reptile: whether the algorithm draws tasks and makes meta-steps by itself; all others do so by a
        :class:`~sb3_progpolicy.ReptileWrapper` where its arguments are given. Such an algorithm makes its environments
        from an id, and its runs can be resumed
    :param source: where it comes from
    :param policies: policies of this package that the algorithm accepts besides its own, by alias
    """

    name: str
    algorithm: type[OnPolicyAlgorithm]
    policy: str
    hyperparams: str
    across_variations: bool
    has_reptile: bool
    source: str
    policies: Mapping[str, type[BasePolicy]] = field(default_factory=dict)

    @property
    def all_policies(self) -> dict[str, type[BasePolicy]]:
        """Every policy that the algorithm accepts, by alias."""
        return {**self.algorithm.policy_aliases, **self.policies}


METHODS: Mapping[str, Method] = MappingProxyType(
    {
        method.name: method
        for method in (
            Method(
                name="reptile_ppo",
                algorithm=ReptilePPO,
                policy="ProgPolicy",
                hyperparams="reptile_ppo",
                across_variations=True,
                has_reptile=True,
                source="Wu et al., IJCAI 2024",
            ),
            Method(
                name="ppo",
                algorithm=PPO,
                policy="MlpPolicy",
                hyperparams="ppo",
                across_variations=False,
                has_reptile=False,
                source="Schulman et al., 2017",
                policies={"PRLPolicy": ProgrammaticPolicy},
            ),
            Method(
                name="recurrent_ppo",
                algorithm=RecurrentPPO,
                policy="MlpLstmPolicy",
                hyperparams="recurrent_ppo",
                across_variations=False,
                has_reptile=False,
                source="sb3-contrib; Schulman et al., 2017",
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
