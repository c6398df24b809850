"""The two steps that frame the inner updates of a meta-iteration: a task is begun (line 4), theta is moved (line 8)."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch as th

from sb3_progpolicy.reptile.tasks import TaskDistribution, Variation

MetaOptimizerName = Literal["sgd", "adam"]
META_OPTIMIZERS: dict[MetaOptimizerName, type[th.optim.Optimizer]] = {"sgd": th.optim.SGD, "adam": th.optim.Adam}


@dataclass(frozen=True)
class Task:
    """What one meta-iteration trains on.

    :param number: of the meta-iteration, from 0
    :param indices: for each environment, which variation of the :class:`TaskDistribution` it has
    :param variations: for each environment, the values of its parameters
    :param seed: of the environments and of torch; ``None`` where nothing is seeded
    """

    number: int
    indices: tuple[int, ...]
    variations: tuple[Variation, ...]
    seed: int | None


def begin_task(
    parameters: Iterable[th.Tensor],
    tasks: TaskDistribution,
    n_envs: int,
    *,
    n_tasks: int,
    number: int,
    progress: float,
    seed: int | None,
    rng: np.random.Generator,
    replica: int = 0,
) -> tuple[list[th.Tensor], Task, np.random.Generator]:
    """Draw the tasks of a meta-iteration and note the parameters on which it starts (line 4).

    Everything random in a meta-iteration follows from the seed and its number, so that it can be repeated alone.

    :param parameters: of the policy
    :param tasks: the distribution p(T)
    :param n_envs: number of environments, over which the tasks are dealt out
    :param n_tasks: how many tasks to draw, at least 1; no more than ``n_envs`` are
    :param number: of the meta-iteration, from 0
    :param progress: of the training, from 0 to 1
    :param seed: of the training; ``None`` draws from ``rng``
    :param rng: source of randomness where there is no seed
    :param replica: which of the inner loops of a meta-batch this is for, from 0
    :return: theta, a copy of the parameters; the task; the generator for all that is random in it
    """
    task_seed = None
    if seed is not None:
        first, second = np.random.SeedSequence([seed, number, replica]).generate_state(2)
        task_seed, rng = int(first >> 1), np.random.default_rng(int(second))
    n_tasks = min(n_tasks, n_envs)
    drawn = tasks.sample(rng, progress, n_tasks)
    indices, variations = zip(*(drawn[row % n_tasks] for row in range(n_envs)), strict=True)
    return [parameter.detach().clone() for parameter in parameters], Task(number, indices, variations, task_seed), rng


def meta_step(
    theta: Sequence[th.Tensor],
    theta_hat: Sequence[th.Tensor],
    beta: float,
    optimizer: MetaOptimizerName = "sgd",
    state: dict[str, Any] | None = None,
) -> tuple[list[th.Tensor], dict[str, Any]]:
    """Step the initial parameters towards the result of the inner updates (line 8).

    ``theta + beta (theta_hat - theta)``, or a step of Adam on the pseudo-gradient ``theta - theta_hat``. (The paper
    prints line 8 with the opposite sign; its text calls the difference a gradient, which is descended.)

    :param theta: parameters before the inner updates; not changed
    :param theta_hat: parameters after them; not changed
    :param beta: step size
    :param optimizer: ``"sgd"`` for the plain step, or ``"adam"``
    :param state: of the optimizer after the last meta-step; ``None`` before the first; not changed
    :return: the new initial parameters, and the state of the optimizer after this step
    """
    stepped = [th.nn.Parameter(tensor.detach().clone()) for tensor in theta]
    meta_optimizer = META_OPTIMIZERS[optimizer](stepped, lr=beta)  # type: ignore[call-arg]
    if state is not None:
        meta_optimizer.load_state_dict(copy.deepcopy(state))
        for group in meta_optimizer.param_groups:
            group["lr"] = beta
    for parameter, before, after in zip(stepped, theta, theta_hat, strict=True):
        parameter.grad = before - after
    meta_optimizer.step()
    return [parameter.detach() for parameter in stepped], meta_optimizer.state_dict()


class MetaOptimizer:
    """Applies :func:`meta_step` to a policy's parameters and keeps the optimizer's state between two steps.

    :param name: ``"sgd"`` or ``"adam"``
    :raises ValueError: for another name
    """

    def __init__(self, name: MetaOptimizerName) -> None:
        if name not in META_OPTIMIZERS:
            raise ValueError(f"meta_optimizer={name!r} is not accepted; known: {', '.join(META_OPTIMIZERS)}")
        self.name = name
        self._state: dict[str, Any] | None = None

    @th.no_grad()
    def step(self, parameters: Iterable[th.Tensor], theta: Sequence[th.Tensor], beta: float) -> float:
        """Move the parameters, which are theta_hat, to the new theta.

        :param parameters: of the policy; changed in place
        :param theta: what they were before the inner updates
        :param beta: step size
        :return: the length of the step from the old theta to the new one
        """
        theta_hat = list(parameters)
        with th.enable_grad():
            stepped, self._state = meta_step(
                theta, [tensor.detach() for tensor in theta_hat], beta, self.name, self._state
            )
        for parameter, value in zip(theta_hat, stepped, strict=True):
            parameter.copy_(value)
        return float(th.stack([(now - was).norm() for now, was in zip(stepped, theta, strict=True)]).norm())

    def drop(self, index: int) -> None:
        """Drop what is remembered of one parameter, so that its momentum does not move it on.

        :param index: of the parameter
        """
        if self._state is not None:
            self._state["state"].pop(index, None)

    def reset(self) -> None:
        """Drop all that is remembered."""
        self._state = None

    def state_dict(self) -> dict[str, Any]:
        """Return the optimizer's state; empty before the first step."""
        return self._state or {}

    def load_state_dict(self, state: dict[str, Any], strict: bool = True) -> None:
        """Take over a state from :meth:`state_dict`."""
        self._state = state if state.get("param_groups") else None
