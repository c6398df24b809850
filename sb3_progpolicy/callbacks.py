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

    What is measured and saved is the policy that ``ReptilePPO`` ends with, not that policy after some updates on the
    task in hand (theta, not theta-hat, of algorithm 1): an evaluation that falls due after the first of the
    ``inner_updates`` of a task waits for the next task, or for the end of the training.

    :param eval_env: an environment or a ``VecEnv``, with the history appended or without
    :param args: all others are those of ``EvalCallback``, in the same order
    :param kwargs: the same by name
    """

    def __init__(self, eval_env: Any, *args: Any, **kwargs: Any) -> None:
        super().__init__(eval_env, *args, **kwargs)
        self._given_env = self.eval_env
        self._meta_iteration: int | None = None
        self._is_adapted = self._is_due = False

    def _init_callback(self) -> None:
        self.eval_env = self._given_env
        if appends_history(self.training_env) and not appends_history(self.eval_env):
            self.eval_env = VecInteractionHistory(self.eval_env)
        super()._init_callback()

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._meta_iteration, self._is_adapted, self._is_due = None, False, False

    def _on_rollout_start(self) -> None:
        super()._on_rollout_start()
        if getattr(self.model, "meta_update", False):
            before, self._meta_iteration = self._meta_iteration, self.model.meta_iteration  # type: ignore[attr-defined]
            self._is_adapted = before == self._meta_iteration

    def _on_step(self) -> bool:
        self._is_due |= self.eval_freq > 0 and self.n_calls % self.eval_freq == 0
        return self._is_adapted or not self._is_due or self._evaluate()

    def _on_training_end(self) -> None:
        super()._on_training_end()
        if self._is_due:
            self._evaluate()

    def _evaluate(self) -> bool:
        """Evaluate now; return whether training goes on."""
        self._is_due, freq = False, self.eval_freq
        self.eval_freq = 1
        try:
            return super()._on_step()
        finally:
            self.eval_freq = freq
