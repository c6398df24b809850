"""A rollout: its buffer, laid out as whole sequences, and the two ways to choose actions while it is collected."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import obs_as_tensor

from sb3_progpolicy.differentiable.sampler import ProgramSampler
from sb3_progpolicy.normalization import NormalizingExtractor
from sb3_progpolicy.policies import ProgrammaticActorCritic

Batch = dict[str, th.Tensor]


class SequenceBuffer(RolloutBuffer):
    """A rollout buffer that hands out whole sequences; nothing resets inside a rollout, so nothing is padded."""

    def reset(self) -> None:
        """Empty the buffer."""
        super().reset()
        #: The recurrent states at which the sequences start; empty for a policy without a state.
        self.sequence_states: list[RNNStates] = []
        #: The values of B that an actor has recorded, ``(n_steps, n_envs, n_conditions)``, or ``None``.
        self.condition_values: NDArray[np.float32] | None = None

    def put(
        self,
        step: int,
        observations: NDArray[np.generic],
        actions: NDArray[np.generic],
        rewards: NDArray[np.floating],
        episode_starts: NDArray[np.bool_],
    ) -> None:
        """Store one step of every environment; values and log-probabilities are the actor's to store."""
        self.observations[step] = np.reshape(observations, self.observations.shape[1:])
        self.actions[step] = actions.reshape(self.n_envs, -1)
        self.rewards[step] = rewards
        self.episode_starts[step] = episode_starts

    def lay_out(self, array: NDArray[np.generic], sequence_length: int) -> th.Tensor:
        """Turn ``(n_steps, n_envs, ...)`` into ``(n_sequences, sequence_length, ...)``."""
        split = array.reshape(-1, sequence_length, self.n_envs, *array.shape[2:]).swapaxes(1, 2)
        return th.as_tensor(split.reshape(-1, sequence_length, *array.shape[2:]), device=self.device)

    def typed(self, actions: th.Tensor) -> th.Tensor:
        """Return stored actions, ``(..., action_dim)``, as the distributions take them."""
        if isinstance(self.action_space, spaces.Discrete):
            return actions.long().squeeze(-1)
        if isinstance(self.action_space, spaces.MultiDiscrete):
            return actions.long()
        return actions.float() if isinstance(self.action_space, spaces.MultiBinary) else actions

    def sequences(self, sequence_length: int) -> Batch:
        """Return the rollout as tensors ``(n_sequences, sequence_length, ...)``, with the states at their starts."""
        names = ("observations", "actions", "log_probs", "advantages", "returns", "values")
        rollout = {name: self.lay_out(getattr(self, name), sequence_length) for name in names}
        rollout["actions"] = self.typed(rollout["actions"])
        if self.sequence_states:
            for part in ("pi", "vf"):
                for i, kind in enumerate("hc"):
                    states = [getattr(sequence, part)[i] for sequence in self.sequence_states]
                    rollout[part + kind] = th.cat(states, dim=1).transpose(0, 1)
        return rollout


def states_of(batch: Batch) -> RNNStates:
    """Return the states at which the sequences of a batch start."""
    pi, vf = (tuple(batch[part + kind].transpose(0, 1).contiguous() for kind in "hc") for part in ("pi", "vf"))
    return RNNStates(pi, vf)


def minibatches(
    n_sequences: int, per_batch: int, n_epochs: int, rng: np.random.Generator
) -> Iterator[NDArray[np.int64]]:
    """Yield the indices of the sequences of every minibatch, in a new order in each epoch."""
    for _ in range(n_epochs):
        order = rng.permutation(n_sequences)
        yield from (order[start : start + per_batch] for start in range(0, n_sequences, per_batch))


#: Of the steps of a rollout, each so many is looked at for how often soft and crisp disagree.
DISAGREEMENT_STRIDE = 8


class Actor(Protocol):
    """Chooses the actions of a rollout and keeps the recurrent states meanwhile."""

    @property
    def states(self) -> RNNStates | None:
        """The recurrent states after the last step."""

    def act(self, observations: NDArray[np.generic], step: int) -> NDArray[np.generic]:
        """Draw actions ``(n_envs, *action_shape)``, Discrete ones from 0 on."""

    def complete(self, buffer: SequenceBuffer) -> None:
        """Store what the update needs besides: values and log-probabilities."""


class PolicyActor:
    """Asks the policy itself: for networks, and on a GPU.

    :param policy: any actor-critic policy
    :param states: the recurrent states at the start, ``None`` for a policy without
    :param buffer: values and log-probabilities are stored here at every step
    """

    def __init__(self, policy: ActorCriticPolicy, states: RNNStates | None, buffer: SequenceBuffer) -> None:
        self.policy, self.states, self.buffer = policy, states, buffer

    @th.no_grad()
    def act(self, observations: NDArray[np.generic], step: int) -> NDArray[np.generic]:
        """See :class:`Actor`."""
        obs = obs_as_tensor(observations, self.policy.device)
        if self.states is None:
            actions, values, log_probs = self.policy(obs)
        else:
            starts = th.zeros(len(obs), device=self.policy.device)  # states survive the end of an episode
            actions, values, log_probs, self.states = self.policy(obs, self.states, starts)
        self.buffer.values[step] = values.cpu().numpy().ravel()
        self.buffer.log_probs[step] = log_probs.cpu().numpy()
        return actions.cpu().numpy()

    def complete(self, buffer: SequenceBuffer) -> None:
        """Do nothing: all is stored."""


class SamplerActor:
    """Draws actions from a program without torch's cost per call; values and log-probabilities follow all at once.

    :param policy: a program, on the CPU
    :param states: the recurrent states at the start, ``None`` for a program without
    :param n_envs: number of environments
    :param n_steps: steps of the rollout
    :param rng: source of all randomness
    """

    def __init__(
        self,
        policy: ProgrammaticActorCritic,
        states: RNNStates | None,
        n_envs: int,
        n_steps: int,
        rng: np.random.Generator,
    ) -> None:
        self.policy, self.recurrent = policy, states is not None
        module = policy.module
        state = module.initial_state(n_envs) if states is None else (states.pi[0], states.pi[1])
        self.sampler = ProgramSampler(module, state, n_steps, rng, getattr(policy, "log_std", None))
        self.action_shape = (n_envs, *(policy.action_space.shape or ()))
        extractor = policy.features_extractor
        #: Share of the rollout's steps on which the soft and the crisp program would not choose the same.
        self.crisp_disagreement = 0.0
        self.normalizer = extractor if isinstance(extractor, NormalizingExtractor) else None

    @property
    def states(self) -> RNNStates | None:
        """See :class:`Actor`."""
        return RNNStates(self.sampler.state, self.sampler.state) if self.recurrent else None

    def act(self, observations: NDArray[np.generic], step: int) -> NDArray[np.generic]:
        """See :class:`Actor`."""
        features = np.asarray(observations, dtype=np.float32)
        if self.normalizer is not None:
            features = self.normalizer(th.from_numpy(features)).numpy()
        return self.sampler.sample(features).reshape(self.action_shape)

    @th.no_grad()
    def complete(self, buffer: SequenceBuffer) -> None:
        """Store the values of the conditions, of the critic, and the log-probabilities of the actions."""
        buffer.condition_values = self.sampler.condition_values
        arrays = (buffer.observations, buffer.condition_values, buffer.actions)
        observations, condition_values, actions = (th.from_numpy(array).flatten(0, 1) for array in arrays)
        values, log_probs = self.policy.evaluate_condition_values(observations, condition_values, buffer.typed(actions))
        rows = slice(None, None, DISAGREEMENT_STRIDE)
        self.crisp_disagreement = self.policy.crisp_disagreement(observations[rows], condition_values[rows])
        buffer.values[:], buffer.log_probs[:] = (
            tensor.numpy().reshape(buffer.values.shape) for tensor in (values, log_probs)
        )
