"""Action distributions of programs."""

from __future__ import annotations

import math
from typing import Any

import torch as th
from stable_baselines3.common.distributions import DiagGaussianDistribution


class NormalizedCategorical(th.distributions.Categorical):
    """A categorical distribution from log-probabilities whose exponentials sum to 1 already.

    Torch's own normalises them again, twice, which took as long as mixing them.

    :param log_probs: ``(..., n_choices)``
    """

    def __init__(self, log_probs: th.Tensor) -> None:
        self.logits = log_probs
        self.probs = log_probs.exp()
        self._param = self.logits
        self._num_events = log_probs.shape[-1]
        th.distributions.Distribution.__init__(self, log_probs.shape[:-1], validate_args=False)


class BranchMixture(DiagGaussianDistribution):
    """A Gaussian around the output of each controller, mixed by how probable it is that the controller decides.

    That is what a program does whose branches are drawn: ``p(a) = sum_k mass_k N(a; C_k(x), std)``. (A Gaussian around
    the mixed output is another thing: the mean of two controllers is a third one that nobody runs.)

    :param action_dim: numbers of an action
    """

    log_masses: th.Tensor
    means: th.Tensor
    log_std: th.Tensor

    def proba_distribution(self, mean_actions: th.Tensor, log_std: th.Tensor) -> BranchMixture:
        """Set the parameters.

        :param mean_actions: ``(n, n_controllers * (1 + action_dim))``: the logarithms of the masses, then the means
        :param log_std: ``(action_dim,)``
        """
        n_controllers = mean_actions.shape[-1] // (1 + self.action_dim)
        self.log_masses = mean_actions[:, :n_controllers]
        self.means = mean_actions[:, n_controllers:].unflatten(1, (n_controllers, self.action_dim))
        self.log_std = log_std
        return self

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """Return the log-density ``(n,)`` of actions ``(n, action_dim)``."""
        distances = (actions.unsqueeze(1) - self.means) * (-self.log_std).exp()
        constant = self.log_std.sum() + 0.5 * self.action_dim * math.log(2 * math.pi)
        return th.logsumexp(self.log_masses - 0.5 * distances.square().sum(-1), dim=1) - constant

    def entropy(self) -> th.Tensor | None:
        """Return ``None``: it has no closed form. SB3 then estimates it by ``-log_prob``."""
        return None

    def sample(self) -> th.Tensor:
        """Draw a controller for each row, then its action."""
        chosen = self._of(th.multinomial(self.log_masses.exp(), 1)[:, 0])
        return chosen + self.log_std.exp() * th.randn_like(chosen)

    def mode(self) -> th.Tensor:
        """Return what the most probable controller gives."""
        return self._of(self.log_masses.argmax(1))

    def _of(self, controllers: th.Tensor) -> th.Tensor:
        return self.means[th.arange(len(self.means), device=self.means.device), controllers]

    def actions_from_params(self, mean_actions: th.Tensor, log_std: th.Tensor, deterministic: bool = False) -> Any:
        """Return actions for parameters, see :meth:`proba_distribution`."""
        return self.proba_distribution(mean_actions, log_std).get_actions(deterministic=deterministic)
