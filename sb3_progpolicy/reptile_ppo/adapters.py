"""What the algorithm has to know of a policy: networks or programs, with a state or without. Nothing else asks."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_progpolicy.policies import ProgrammaticActorCritic
from sb3_progpolicy.reptile_ppo.rollout import Actor, Batch, PolicyActor, SamplerActor, SequenceBuffer, states_of

if TYPE_CHECKING:
    from sb3_progpolicy.differentiable.search import DerivationSearch

Evaluated = tuple[th.Tensor | None, th.Tensor, th.Tensor | None]


class Adapter:
    """A network without a state.

    :param policy: what is trained
    """

    recurrent = False

    def __init__(self, policy: ActorCriticPolicy) -> None:
        self.policy = policy

    @property
    def search(self) -> DerivationSearch | None:
        """W; ``None`` for a network."""
        return None

    def initial_states(self, n_envs: int) -> RNNStates | None:
        """Return zero states; ``None`` for a policy without."""
        return None

    def make_actor(
        self, states: RNNStates | None, buffer: SequenceBuffer, n_steps: int, rng: np.random.Generator
    ) -> Actor:
        """Return what chooses the actions of a rollout, the fast sampler where it can."""
        return PolicyActor(self.policy, states, buffer)

    def predict_values(self, obs: th.Tensor, states: RNNStates | None, rows: Iterable[int] | slice) -> th.Tensor:
        """Return the critic's values ``(n, 1)``.

        :param obs: observations of some environments
        :param states: of all environments
        :param rows: which environments these are
        """
        return self.policy.predict_values(obs)

    def evaluate(self, batch: Batch) -> Evaluated:
        """Return values, log-probabilities and entropies of a batch of sequences, all ``(n_sequences * length,)``."""
        return self.policy.evaluate_actions(batch["observations"].flatten(0, 1), batch["actions"].flatten(0, 1))

    def set_temperature(self, temperature: float) -> None:
        """Set the temperature of the conditions; a network has none."""

    def set_action_temperature(self, temperature: float) -> None:
        """Set the temperature of discrete actions; a network has none."""

    def freeze(self, derivation: bool, phi: bool) -> None:
        """Freeze W, or everything else, or neither; a network has no W."""

    def derivation_batch(self, rollout: Batch, condition_values: th.Tensor | None) -> Batch:
        """Return what an update of W needs of a rollout."""
        raise TypeError(f"{type(self.policy).__name__} has no W; ProgPolicy and PRLPolicy have")

    def log(self, logger: Logger, actor: Actor) -> None:
        """Log what is particular to the policy."""


class RecurrentAdapter(Adapter):
    """A network with a state."""

    recurrent = True
    policy: Any

    def initial_states(self, n_envs: int) -> RNNStates | None:
        """See :class:`Adapter`."""
        lstm = self.policy.lstm_actor
        shape = (lstm.num_layers, n_envs, lstm.hidden_size)
        pi, vf = (tuple(th.zeros(shape, device=self.policy.device) for _ in range(2)) for _ in range(2))
        return RNNStates(pi, vf)

    def predict_values(self, obs: th.Tensor, states: RNNStates | None, rows: Iterable[int] | slice) -> th.Tensor:
        """See :class:`Adapter`."""
        assert states is not None
        pair = tuple(state[:, rows].contiguous() for state in states.vf)  # type: ignore[index]
        return self.policy.predict_values(obs, pair, th.zeros(len(obs), device=obs.device))

    def evaluate(self, batch: Batch) -> Evaluated:
        """See :class:`Adapter`."""
        observations = batch["observations"].flatten(0, 1)
        starts = th.zeros(len(observations), device=observations.device)
        return self.policy.evaluate_actions(observations, batch["actions"].flatten(0, 1), states_of(batch), starts)


class _ProgramAdapter(Adapter):
    """What holds for programs, with a state or without."""

    policy: Any

    @property
    def search(self) -> DerivationSearch | None:
        """W."""
        return self.policy.module.search

    def make_actor(
        self, states: RNNStates | None, buffer: SequenceBuffer, n_steps: int, rng: np.random.Generator
    ) -> Actor:
        """See :class:`Adapter`."""
        if self.policy.device.type != "cpu":
            return super().make_actor(states, buffer, n_steps, rng)
        return SamplerActor(self.policy, states, buffer.n_envs, n_steps, rng)

    def set_temperature(self, temperature: float) -> None:
        """See :class:`Adapter`."""
        self.policy.set_temperature(temperature)

    def set_action_temperature(self, temperature: float) -> None:
        """See :class:`Adapter`."""
        self.policy.set_action_temperature(temperature)

    def freeze(self, derivation: bool, phi: bool) -> None:
        """See :class:`Adapter`."""
        self.policy.optimizer.zero_grad()
        for parameter in self.policy.derivation_parameters():
            parameter.requires_grad_(not derivation)
        for parameter in self.policy.phi():
            parameter.requires_grad_(not phi)

    @th.no_grad()
    def derivation_batch(self, rollout: Batch, condition_values: th.Tensor | None) -> Batch:
        """See :class:`Adapter`. With phi frozen the terms that W mixes stay the same throughout the update."""
        observations = rollout["observations"].flatten(0, 1)
        if condition_values is None:
            states = states_of(rollout).pi if self.recurrent else None
            condition_values = self.policy.condition_values(observations, states)
        terms = self.policy.derivation_terms(observations, condition_values.flatten(0, -2))
        shape = rollout["advantages"].shape
        return {
            "terms": terms.unflatten(0, shape),
            **{name: rollout[name] for name in ("actions", "log_probs", "advantages")},
        }

    def evaluate(self, batch: Batch) -> Evaluated:
        """See :class:`Adapter`. Values are ``None`` in an update of W."""
        if "terms" not in batch:
            return super().evaluate(batch)
        return None, *self.policy.evaluate_derivation(batch["terms"].flatten(0, 1), batch["actions"].flatten(0, 1))

    @th.no_grad()
    def log(self, logger: Logger, actor: Actor) -> None:
        """Log W and how often each branch was taken: C'_k is ``branch_then_k``, C_k is ``branch_last_k``."""
        module = self.policy.module
        for n_conditions, probability in enumerate(module.search.probabilities().tolist()):
            logger.record(f"program/prob_{n_conditions}_conditions", probability)
        logger.record("program/search_entropy", module.search.entropy().item())
        logger.record("program/temperature", module.temperature.item())
        logger.record("program/action_temperature", module.action_temperature.item())
        if isinstance(actor, SamplerActor):
            logger.record("program/crisp_disagreement", actor.crisp_disagreement)
            names = [f"then_{k}" for k in range(1, module.depth)] + [f"last_{k}" for k in range(1, module.depth + 1)]
            for name, share in zip(names, actor.sampler.branch_frequencies(), strict=True):
                logger.record(f"program/branch_{name}", share)


class ProgramAdapter(_ProgramAdapter, Adapter):
    """A program without a state."""


class RecurrentProgramAdapter(_ProgramAdapter, RecurrentAdapter):
    """A program with a state."""


def adapt(policy: ActorCriticPolicy) -> Adapter:
    """Return the adapter of a policy."""
    recurrent = isinstance(policy, RecurrentActorCriticPolicy)
    if isinstance(policy, ProgrammaticActorCritic):
        return RecurrentProgramAdapter(policy) if recurrent else ProgramAdapter(policy)
    return RecurrentAdapter(policy) if recurrent else Adapter(policy)
