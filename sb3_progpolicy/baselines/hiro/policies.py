"""Both levels of a HIRO agent as one SB3 policy, with a ``predict`` that keeps the goal from step to step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from sb3_progpolicy.baselines.discrete_sac.policies import DiscreteSACPolicy
from sb3_progpolicy.baselines.hiro.goals import goal_transition, scaled


class GoalState(NamedTuple):
    """What an agent remembers from step to step, for each environment.

    :param goals: proposed last, in units of the scale, ``(n_envs, n_goal_dims)``
    :param starts: positions in which they were proposed, ``(n_envs, n_goal_dims)``
    :param ages: steps made under them before this one, ``(n_envs,)``
    """

    goals: NDArray[np.float32]
    starts: NDArray[np.float32]
    ages: NDArray[np.int64]


class HIROPolicy(BasePolicy):
    """A high level that proposes goals, and a low level that reads observation and goal and acts.

    The high level is a ``TD3Policy`` of SB3 whose actions are goals in units of the scale. For ``Box`` actions the low
    level is one too; for ``Discrete`` actions it is a
    :class:`~sb3_progpolicy.baselines.discrete_sac.DiscreteSACPolicy`.

    :param observation_space: one-dimensional ``Box``
    :param action_space: ``Box`` or ``Discrete``
    :param lr_schedule: learning rate as a function of the progress remaining
    :param goal_dims: indices of the observation that goals address
    :param goal_period: steps under one goal
    :param net_arch: units of the hidden layers of all networks, or ``{"pi": [...], "qf": [...]}``; 300, 300 by default,
        as in the paper
    :param activation_fn: between layers
    :param optimizer_class: of all networks
    :param optimizer_kwargs: its arguments besides the learning rate
    :param n_critics: number of critics of each level
    """

    action_space: spaces.Box | spaces.Discrete
    goal_scale: th.Tensor
    goal_dims: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        goal_dims: Sequence[int],
        goal_period: int,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        n_critics: int = 2,
    ) -> None:
        super().__init__(
            observation_space,
            action_space,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=isinstance(action_space, spaces.Box),
        )
        assert observation_space.shape is not None
        self.goal_period = goal_period
        self.register_buffer("goal_dims", th.tensor(goal_dims, dtype=th.long))
        self.register_buffer("goal_scale", th.zeros(len(goal_dims)))  # until it is given or measured
        self.networks: dict[str, Any] = {
            "net_arch": [300, 300] if net_arch is None else net_arch,
            "activation_fn": activation_fn,
            "optimizer_class": optimizer_class,
            "optimizer_kwargs": optimizer_kwargs,
            "n_critics": n_critics,
        }
        n_inputs = observation_space.shape[0]
        goal_space = spaces.Box(-1.0, 1.0, (len(goal_dims),), np.float32)
        # Spaces only tell the networks their sizes here; bounds are not read.
        flat_space = spaces.Box(-np.inf, np.inf, (n_inputs,), np.float32)
        low_space = spaces.Box(-np.inf, np.inf, (n_inputs + len(goal_dims),), np.float32)
        self.high = TD3Policy(flat_space, goal_space, lr_schedule, **self.networks)
        self.low: TD3Policy | DiscreteSACPolicy
        if isinstance(action_space, spaces.Discrete):
            self.low = DiscreteSACPolicy(low_space, action_space, lr_schedule, **self.networks)
        else:
            assert isinstance(action_space, spaces.Box)
            self.low = TD3Policy(low_space, action_space, lr_schedule, **self.networks)

    def positions(self, observations: th.Tensor) -> th.Tensor:
        """Return the numbers that goals address, ``(..., n_goal_dims)``."""
        return observations[..., self.goal_dims]

    def low_inputs(self, observations: th.Tensor, goals: th.Tensor) -> th.Tensor:
        """Return what the low level reads, ``(..., obs_dim + n_goal_dims)``.

        :param observations: ``(..., obs_dim)``
        :param goals: from these observations on, in the observation's units, ``(..., n_goal_dims)``
        """
        return th.cat([observations, scaled(goals, self.goal_scale)], dim=-1)

    def goals_since(self, goals: th.Tensor, starts: th.Tensor, positions: th.Tensor) -> th.Tensor:
        """Return goals as they have become on the way from one position to another, in the observation's units.

        Steps of the goal transition add up to one: ``h(s1, h(s0, g, s1), s2) = h(s0, g, s2)``.

        :param goals: proposed at the start, in units of the scale
        :param starts: positions in which they were proposed
        :param positions: now
        """
        return goal_transition(starts, goals * self.goal_scale, positions)

    def action_log_probs(self, inputs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Return how likely the low level makes actions, ``(...,)``, up to a constant (equation 6).

        :param inputs: of the low level, ``(..., obs_dim + n_goal_dims)``
        :param actions: as the replay buffer has them, ``(..., action_dim)``
        """
        flat = inputs.flatten(0, -2)
        if isinstance(self.low, TD3Policy):
            difference = actions.flatten(0, -2) - self.low.actor(flat)
            log_probs = -0.5 * difference.square().sum(dim=-1)
        else:
            chosen = actions.flatten(0, -2).long() - int(self.low.action_space.start)
            log_probs = self.low.actor.log_probs(flat).gather(1, chosen).squeeze(1)
        return log_probs.view(inputs.shape[:-1])

    def next_goals(
        self,
        observations: th.Tensor,
        state: GoalState | None,
        episode_start: NDArray[np.bool_] | None,
        propose: Callable[[th.Tensor], th.Tensor] | None = None,
    ) -> GoalState:
        """Return the goals for a step: new ones where an episode starts or ``goal_period`` steps are over.

        :param observations: of the step, ``(n_envs, obs_dim)``
        :param state: of the step before; ``None`` where there was none
        :param episode_start: whether an episode starts, ``(n_envs,)``; ``None`` for nowhere
        :param propose: makes goals in units of the scale of observations; the high level's actor by default
        :raises ValueError: if the state is not of as many environments as there are observations
        """
        n_envs, n_dims = len(observations), len(self.goal_dims)
        positions = self.positions(observations).cpu().numpy()
        if state is None:
            state = GoalState(np.zeros((n_envs, n_dims), np.float32), positions, np.full(n_envs, -1))
            expired = np.ones(n_envs, dtype=bool)
        else:
            if len(state[0]) != n_envs:
                raise ValueError(f"the state is of {len(state[0])} environments; there are {n_envs} observations")
            state = GoalState(*state)
            expired = state.ages + 1 >= self.goal_period
        if episode_start is not None:
            expired = expired | np.asarray(episode_start, dtype=bool)
        ages = np.where(expired, 0, state.ages + 1)
        if not expired.any():
            return GoalState(state.goals, state.starts, ages)
        with th.no_grad():
            proposed = (propose or self.high.actor)(observations).cpu().numpy()
        column = expired[:, None]
        return GoalState(np.where(column, proposed, state.goals), np.where(column, positions, state.starts), ages)

    def act(self, observations: th.Tensor, state: GoalState, deterministic: bool) -> th.Tensor:
        """Return the low level's actions, in -1 to 1 for ``Box``.

        :param observations: ``(n_envs, obs_dim)``
        :param state: of the step
        :param deterministic: whether ``Discrete`` actions are the most likely ones rather than drawn
        """
        goals, starts = (th.as_tensor(part, device=observations.device) for part in (state.goals, state.starts))
        with th.no_grad():
            remaining = self.goals_since(goals, starts, self.positions(observations))
            return self.low(self.low_inputs(observations, remaining), deterministic)

    def predict(
        self,
        observation: NDArray[Any] | dict[str, NDArray[Any]],
        state: tuple[NDArray[Any], ...] | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], tuple[NDArray[Any], ...] | None]:
        """Return actions and the state to give with the next observation, as SB3's recurrent policies do.

        :param observation: one, or one of each environment
        :param state: returned with the last observation; ``None`` asks for a new goal
        :param episode_start: whether an episode starts, ``(n_envs,)``
        :param deterministic: whether ``Discrete`` actions are the most likely ones rather than drawn; ``Box`` actions
            always are deterministic
        :raises ValueError: if the state is not of as many environments as there are observations
        :raises FloatingPointError: if an observation is not finite
        """
        self.set_training_mode(False)
        tensor, vectorized = self.obs_to_tensor(observation)
        assert isinstance(tensor, th.Tensor)
        tensor = tensor.float()
        if not bool(th.isfinite(tensor).all()):
            raise FloatingPointError("the observation is not finite (NaN or infinite); no action follows from it")
        known = None if state is None else GoalState(*state)
        new_state = self.next_goals(tensor, known, episode_start)
        actions = self.act(tensor, new_state, deterministic).cpu().numpy().reshape(-1, *(self.action_space.shape or ()))
        if isinstance(self.action_space, spaces.Box):
            actions = self.unscale_action(actions)
        return (actions if vectorized else actions[0]), new_state

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """Return actions under new goals."""
        return self._predict(obs, deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        assert isinstance(observation, th.Tensor)
        observation = observation.float()
        return self.act(observation, self.next_goals(observation, None, None), deterministic)

    def set_training_mode(self, mode: bool) -> None:
        """Switch both levels between training and evaluation.

        :param mode: whether for training
        """
        self.high.set_training_mode(mode)
        self.low.set_training_mode(mode)
        self.training = mode

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            "observation_space": self.observation_space,
            "action_space": self.action_space,
            "lr_schedule": self._dummy_schedule,
            "goal_dims": self.goal_dims.tolist(),
            "goal_period": self.goal_period,
            **self.networks,
        }
