"""Theta: all that an inner loop starts from and changes."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch as th

if TYPE_CHECKING:
    from sb3_progpolicy.normalization import RewardScaler
    from sb3_progpolicy.reptile_ppo.sequence_ppo import SequencePPO


@dataclass(frozen=True)
class Theta:
    """The initial parameters of algorithm 1, and what else decides what the inner updates make of them.

    :param policy: state dict of the policy: W, phi, the critic, statistics of the observations
    :param optimizer: state dict of the inner optimizer
    :param reward_scaler: statistics of the returns; ``None`` where rewards are not scaled
    :param num_timesteps: environment steps made so far
    :param total_timesteps: of the whole training, from which the schedules follow
    """

    policy: dict[str, th.Tensor]
    optimizer: dict[str, Any]
    reward_scaler: RewardScaler | None
    num_timesteps: int
    total_timesteps: int

    @classmethod
    def of(cls, model: SequencePPO) -> Theta:
        """Copy what a model holds."""
        return cls(
            {name: tensor.detach().clone() for name, tensor in model.policy.state_dict().items()},
            copy.deepcopy(model.policy.optimizer.state_dict()),
            copy.deepcopy(model.reward_scaler),
            model.num_timesteps,
            model._total_timesteps,
        )

    def put_into(self, model: SequencePPO) -> None:
        """Give a model copies of all of it."""
        model.policy.load_state_dict(self.policy)
        model.policy.optimizer.load_state_dict(copy.deepcopy(self.optimizer))
        model.reward_scaler = copy.deepcopy(self.reward_scaler)
        model.num_timesteps, model._total_timesteps = self.num_timesteps, self.total_timesteps
        model._update_current_progress_remaining(self.num_timesteps, max(1, self.total_timesteps))
