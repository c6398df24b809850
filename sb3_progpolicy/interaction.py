"""What the policy sees besides the observation: its previous action, reward and done flag (section 2.4)."""

from __future__ import annotations

from typing import Any, cast

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import (
    VecEnv,
    VecEnvWrapper,
    VecNormalize,
    is_vecenv_wrapped,
    unwrap_vec_wrapper,
)
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn
from typing_extensions import deprecated

from sb3_progpolicy.names import Names, readable_names
from sb3_progpolicy.spaces import action_spec, encode_actions, interaction_space


class InteractionHistory(gym.ObservationWrapper[NDArray[np.float32], Any, Any], gym.utils.RecordConstructorArgs):
    """Append the previous action, reward and done flag to the observation of one environment (section 2.4).

    They survive the end of an episode: the first observation of the next one shows the last action and reward and a
    done flag of 1. They are zero before the first action, after :meth:`reset_history`, and after a reset with a seed
    or a variation.

    :param env: an environment with one-dimensional Box observations
    :raises ValueError: if a space is not accepted
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.ObservationWrapper.__init__(self, env)
        self.spec_of_actions = action_spec(env.action_space)
        self.observation_space = interaction_space(env.observation_space, self.spec_of_actions)  # type: ignore[assignment]
        self.reset_history()

    def reset_history(self) -> None:
        """Zero the history, as at the start of a task."""
        self._history = np.zeros(self.spec_of_actions.interaction_size, dtype=np.float32)

    @deprecated("InteractionHistory.forget is now called reset_history")
    def forget(self) -> None:
        """The former name of :meth:`reset_history`."""
        self.reset_history()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; given ``seed`` or ``options``, a new task too, which zeroes the history."""
        if options or seed is not None:
            self.reset_history()
        return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[NDArray[np.float32], Any, bool, bool, dict[str, Any]]:
        """Step the environment and remember what was done."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        encoded = encode_actions(np.asarray(action)[None], self.spec_of_actions)[0]
        self._history = np.concatenate((encoded, np.array([reward, terminated], dtype=np.float32)))
        joined = self.observation(observation)
        self._history[-1] = terminated or truncated
        return joined, reward, terminated, truncated, info

    def observation(self, observation: NDArray[Any]) -> NDArray[np.float32]:
        """Return X."""
        return np.concatenate((observation, self._history), dtype=np.float32)


class VecInteractionHistory(VecEnvWrapper):
    """The same for a vectorised environment.

    :param venv: environments with one-dimensional Box observations
    :raises ValueError: if a space is not accepted
    """

    def __init__(self, venv: VecEnv) -> None:
        self.spec_of_actions = action_spec(venv.action_space)
        super().__init__(venv, observation_space=interaction_space(venv.observation_space, self.spec_of_actions))
        self._actions = np.zeros((self.num_envs, self.spec_of_actions.history_size), dtype=np.float32)

    def reset(self) -> NDArray[np.float32]:
        """Start a task in every environment: the history is zero."""
        observations = cast(NDArray[Any], self.venv.reset())
        zeros = np.zeros((self.num_envs, self.spec_of_actions.interaction_size), dtype=np.float32)
        return np.concatenate((observations, zeros), axis=1, dtype=np.float32)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Remember the actions and pass them on."""
        self._actions = encode_actions(actions, self.spec_of_actions)
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """Join the observations, and the terminal observations in the infos, with the history."""
        observations, rewards, dones, infos = self.venv.step_wait()
        joined = np.concatenate(
            (observations, self._actions, rewards[:, None], dones[:, None]),  # type: ignore[arg-type]
            axis=1,
            dtype=np.float32,
        )
        for row in dones.nonzero()[0]:
            info = infos[row]
            if "terminal_observation" in info:
                # A truncated episode could have gone on: its value is that of a state that is not the end.
                ended = not info.get("TimeLimit.truncated", False)
                info["terminal_observation"] = np.concatenate(
                    (info["terminal_observation"], self._actions[row], [rewards[row], ended]), dtype=np.float32
                )
        return joined, rewards, dones, infos


def appends_history(venv: VecEnv) -> bool:
    """Return whether observations end with the interaction history, whichever wrapper appends it."""
    return is_vecenv_wrapped(venv, VecInteractionHistory) or any(venv.env_is_wrapped(InteractionHistory))


def reads_scaled_rewards(venv: VecEnv) -> bool:
    """Return whether the interaction history shows rewards that ``VecNormalize``, beneath what appends it, scales.

    :param venv: environments with the history
    """
    while isinstance(venv, VecEnvWrapper):
        if isinstance(venv, VecInteractionHistory):
            normalizer = unwrap_vec_wrapper(venv.venv, VecNormalize)
            return normalizer is not None and normalizer.norm_reward
        venv = venv.venv
    return False


def program_names(venv: VecEnv) -> Names:
    """Return readable names of a program's inputs and outputs.

    See :func:`~sb3_progpolicy.names.readable_names`.

    :param venv: the environments a program is trained in
    :return: one name per number of X, one per controller output
    """
    spec = action_spec(venv.action_space)
    history = appends_history(venv)
    n_observations = int(np.prod(venv.observation_space.shape or (0,))) - history * spec.interaction_size
    observations, actions, registered = (
        venv.get_attr(attribute)[0] if venv.has_attr(attribute) else None
        for attribute in ("observation_names", "action_names", "spec")
    )
    return readable_names(
        observations, actions, getattr(registered, "id", None), n_observations, spec.n_outputs, history
    )
