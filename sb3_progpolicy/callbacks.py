"""Stable-Baselines3's evaluation during training, for models that read the interaction history."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.callbacks import EvalCallback

from sb3_progpolicy.interaction import VecInteractionHistory, appends_history


class InteractionEvalCallback(EvalCallback):
    """SB3's ``EvalCallback``, for environments as they are made, whatever the model reads.

    Where observations in training end with the interaction history, as in
    :class:`~sb3_progpolicy.reptile_ppo.ReptilePPO`, it is appended here too; otherwise this is ``EvalCallback``.

    .. code-block:: python

        model = ReptilePPO("ProgPolicy", "CartPole-v1")
        model.learn(100_000, callback=InteractionEvalCallback(Monitor(gym.make("CartPole-v1")), eval_freq=1000))

    An evaluation is a task of its own (section 2.4): history and recurrent states are zero at its start and, with
    ``ReptilePPO``, kept across its episodes.

    :param eval_env: an environment or a ``VecEnv``, with the history appended or without
    :param args: all others are those of ``EvalCallback``, in the same order
    :param kwargs: the same by name
    """

    def __init__(self, eval_env: Any, *args: Any, **kwargs: Any) -> None:
        super().__init__(eval_env, *args, **kwargs)
        self._given_env = self.eval_env

    def _init_callback(self) -> None:
        self.eval_env = self._given_env
        if appends_history(self.training_env) and not appends_history(self.eval_env):
            self.eval_env = VecInteractionHistory(self.eval_env)
        super()._init_callback()
