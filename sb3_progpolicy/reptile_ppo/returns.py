"""Whether one program has a higher return than another: whole episodes from the same starts, and their differences.

It is the crisp program that is compared, because it is the one that is read and run. The soft one may gain from a
condition that only makes it surer of what it does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_progpolicy.programs.interpreter import ProgramRunner
from sb3_progpolicy.reptile.callback import start_task
from sb3_progpolicy.reptile.steps import Task
from sb3_progpolicy.reptile_ppo.inner_loops import Learning
from sb3_progpolicy.spaces import shaped

#: Least number of episodes of a program.
MIN_EPISODES = 64
#: Cap on the steps of an episode where the environment has none; what was reached by then counts.
MAX_STEPS = 1000
#: A rise has to be this many standard errors above its price: by chance, that happens in 2 of 100 comparisons. It is
#: too small if it is as far below.
STD_ERRORS = 2.0


def episode_returns(model: Any, task: Task, learning: Learning) -> NDArray[np.float64]:
    """Run whole episodes of the crisp program, without noise, and return their returns ``(n_rounds, n_envs)``.

    Callbacks hear of every step, and it counts as one. Episodes that are not over at the cap count with what they have;
    those that have not begun by then are NaN.

    :param model: a ReptilePPO
    :param task: a variation for every environment, and the seed of its starts
    :param learning: what ``learn`` keeps; told if a callback ends the training
    """
    start_task(model, model.tasks, task)
    env, n_envs = model.env, model.n_envs
    n_rounds = -(-MIN_EPISODES // n_envs)
    returns, number, running = np.full((n_rounds, n_envs), np.nan), np.zeros(n_envs, dtype=int), np.zeros(n_envs)
    runner = ProgramRunner(model.policy.program(), n_envs)
    cap, step = n_rounds * _max_steps(env), 0
    while number.min() < n_rounds and step < cap and not learning.stopped:
        new_obs, rewards, dones, infos = env.step(shaped(runner.act(model._last_obs), env.action_space))
        model._last_obs, step = new_obs, step + 1
        running += rewards
        ended = np.flatnonzero(dones & (number < n_rounds))
        returns[number[ended], ended] = running[ended]
        number[ended] += 1
        running[dones] = 0
        model.num_timesteps += n_envs
        learning.callback.update_locals(locals())
        learning.stopped = not learning.callback.on_step()
    unfinished = np.flatnonzero(number < n_rounds)
    returns[number[unfinished], unfinished] = running[unfinished]
    model._update_current_progress_remaining(model.num_timesteps, max(1, model._total_timesteps))
    return returns


def _max_steps(env: Any) -> int:
    spec = env.get_attr("spec")[0] if env.has_attr("spec") else None
    return MAX_STEPS if spec is None or spec.max_episode_steps is None else int(spec.max_episode_steps)


@dataclass(frozen=True)
class Comparison:
    """How much higher the mean return is with a condition than without.

    :param return_before: mean return without it
    :param rise: mean difference of episodes from the same starts
    :param rise_std_error: standard error of that mean
    :param price: what the rise has to exceed, by ``STD_ERRORS`` standard errors
    """

    return_before: float
    rise: float
    rise_std_error: float
    price: float

    @classmethod
    def of(cls, without: NDArray[np.float64], with_it: NDArray[np.float64], length_coef: float) -> Comparison:
        """Compare two runs of the same episodes.

        :param without: returns ``(n_rounds, n_envs)``, NaN for an episode that was not run
        :param with_it: the same, of the program with the condition
        :param length_coef: price of a condition, in standard deviations of the returns
        """
        there = np.isfinite(without) & np.isfinite(with_it)
        before, difference = without[there], (with_it - without)[there]
        spread = np.sqrt((before.var() + with_it[there].var()) / 2)
        # A single difference says nothing about its error, which is then as good as itself: it never pays.
        error = difference.std(ddof=1) / np.sqrt(len(difference)) if len(difference) > 1 else abs(difference.mean())
        return cls(float(before.mean()), float(difference.mean()), float(error), float(length_coef * spread))

    @property
    def pays(self) -> bool:
        """Whether the condition is worth its price."""
        return self.rise > self.price + STD_ERRORS * self.rise_std_error

    @property
    def undecided(self) -> bool:
        """Whether the noise is larger than the distance from the price, so that nothing is shown."""
        return not self.pays and self.rise + STD_ERRORS * self.rise_std_error > self.price
