"""Programmatic policies for SB3: programs with recurrent conditions, and with affine ones."""

from __future__ import annotations

from typing import Any, cast

import torch as th
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3.common.distributions import Distribution
from torch import nn

from sb3_progpolicy.actor_critic import DERIVATION_LR_SCALE, ProgrammaticActorCritic
from sb3_progpolicy.differentiable.conditions import Conditions, State
from sb3_progpolicy.programs.syntax import STATELESS

__all__ = ["DERIVATION_LR_SCALE", "ProgrammaticActorCritic", "ProgrammaticPolicy", "RecurrentProgrammaticPolicy"]


class RecurrentProgrammaticPolicy(ProgrammaticActorCritic, RecurrentActorCriticPolicy):
    """The policy ``"ProgPolicy"``: a program with recurrent conditions, for ``RecurrentPPO`` and ``ReptilePPO``.

    The states of the conditions take the place of the LSTM states: two tensors ``(1, n_envs, hidden_size)``, the
    second used by LSTM conditions only. The critic has none.

    See :class:`ProgrammaticActorCritic` for the arguments.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.lstm_hidden_state_shape = (1, 1, self.module.conditions.hidden_size)

    @property
    def lstm_actor(self) -> Conditions:  # type: ignore[override]
        """The conditions, under the name by which ``RecurrentPPO`` asks for the size of the state."""
        return self.module.conditions

    def _condition_values(
        self, features: th.Tensor, states: tuple[th.Tensor, ...], episode_starts: th.Tensor
    ) -> tuple[th.Tensor, State]:
        """Run the conditions over sequences laid out one after the other, as RecurrentPPO's batches are."""
        if not self.module.search.needs_conditions:
            return features.new_zeros(len(features), self.module.depth - 1), cast(State, states)
        if not self.reset_state_at_episode_start:
            episode_starts = th.zeros_like(episode_starts)
        conditions = cast(nn.LSTM, self.module.conditions)  # called alike
        return cast(
            tuple[th.Tensor, State], self._process_sequence(features, cast(State, states), episode_starts, conditions)
        )

    def forward(  # type: ignore[override]
        self,
        obs: th.Tensor,
        lstm_states: RNNStates,
        episode_starts: th.Tensor,
        deterministic: bool = False,
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor, RNNStates]:
        """Return actions, values, log-probabilities and new states. See ``RecurrentActorCriticPolicy.forward``."""
        pi_features, vf_features = self._split_features(obs)
        condition_values, states = self._condition_values(pi_features, lstm_states.pi, episode_starts)
        distribution = self._distribution(pi_features, condition_values)
        actions = distribution.get_actions(deterministic=deterministic)
        log_prob = distribution.log_prob(actions)
        actions = actions.reshape((-1, *self.action_space.shape))  # type: ignore[misc]
        return actions, self._values(vf_features), log_prob, RNNStates(states, states)

    def get_distribution(  # type: ignore[override]
        self, obs: th.Tensor, lstm_states: tuple[th.Tensor, th.Tensor], episode_starts: th.Tensor
    ) -> tuple[Distribution, tuple[th.Tensor, ...]]:
        """Return the action distribution and new states. See ``RecurrentActorCriticPolicy.get_distribution``."""
        features, _ = self._split_features(obs)
        condition_values, states = self._condition_values(features, lstm_states, episode_starts)
        return self._distribution(features, condition_values), states

    def predict_values(  # type: ignore[override]
        self,
        obs: th.Tensor,
        lstm_states: tuple[th.Tensor, th.Tensor] | None = None,
        episode_starts: th.Tensor | None = None,
    ) -> th.Tensor:
        """Return the values ``(n, 1)``; the critic has no state, so that the other arguments change nothing."""
        return self._values(self._split_features(obs)[1])

    def evaluate_actions(  # type: ignore[override]
        self, obs: th.Tensor, actions: th.Tensor, lstm_states: RNNStates, episode_starts: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        """Return values, log-probabilities and entropies. See ``RecurrentActorCriticPolicy.evaluate_actions``."""
        pi_features, vf_features = self._split_features(obs)
        condition_values, _ = self._condition_values(pi_features, lstm_states.pi, episode_starts)
        distribution = self._distribution(pi_features, condition_values)
        # RecurrentPPO hands MultiBinary actions over as int8, which a Bernoulli distribution does not take.
        return self._values(vf_features), distribution.log_prob(actions.float()), distribution.entropy()


class ProgrammaticPolicy(ProgrammaticActorCritic):
    """The policy ``"PRLPolicy"``: a program with affine conditions, for SB3's ``PPO`` (PRL, Qiu and Zhu, 2022).

    See :class:`ProgrammaticActorCritic` for the arguments; ``cell`` is ``"affine"``, or ``"min"``.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        if kwargs.setdefault("cell", "affine") not in STATELESS:
            raise ValueError(
                f"cell={kwargs['cell']!r} is not accepted; 'affine' and 'min' are; recurrent cells (gru, lstm, rnn) "
                "are those of RecurrentProgrammaticPolicy"
            )
        super().__init__(*args, **kwargs)

    def _distribution_at(self, features: th.Tensor) -> Distribution:
        return self._distribution(features, self.module.conditions(features, self.module.initial_state(1))[0])

    def forward(self, obs: th.Tensor, deterministic: bool = False) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Return actions, values and log-probabilities. See ``ActorCriticPolicy.forward``."""
        pi_features, vf_features = self._split_features(obs)
        distribution = self._distribution_at(pi_features)
        actions = distribution.get_actions(deterministic=deterministic)
        log_prob = distribution.log_prob(actions)
        actions = actions.reshape((-1, *self.action_space.shape))  # type: ignore[misc]
        return actions, self._values(vf_features), log_prob

    def get_distribution(self, obs: th.Tensor) -> Distribution:  # type: ignore[override]
        """Return the action distribution. See ``ActorCriticPolicy.get_distribution``."""
        return self._distribution_at(self._split_features(obs)[0])

    def predict_values(self, obs: th.Tensor) -> th.Tensor:  # type: ignore[override]
        """Return the values ``(n, 1)``."""
        return self._values(self._split_features(obs)[1])

    def evaluate_actions(  # type: ignore[override]
        self, obs: th.Tensor, actions: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        """Return values, log-probabilities and entropies. See ``ActorCriticPolicy.evaluate_actions``."""
        pi_features, vf_features = self._split_features(obs)
        distribution = self._distribution_at(pi_features)
        return self._values(vf_features), distribution.log_prob(actions), distribution.entropy()
