"""Pruned programs trained on by PPO: the numbers that are left are moved, those that are zero stay zero."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.utils import LinearSchedule

from sb3_progpolicy.analysis.terms import Floats, symmetric_part
from sb3_progpolicy.hyperparams import load_hyperparams
from sb3_progpolicy.programs.program import Program
from sb3_progpolicy.programs.syntax import Condition, Controller, Expression, IfThenElse, ProgramData
from sb3_progpolicy.reptile_ppo.algorithm import ReptilePPO
from sb3_progpolicy.reptile_ppo.initial import read_initial_program
from sb3_progpolicy.surroundings import surroundings

#: Share of the steps in which the critic alone learns: before it knows what the program is worth, PPO would ruin it.
CRITIC_FIRST = 0.25
#: Settings of PPO besides those of the environment's entry in ``hyperparams/reptile_ppo.yml``: small, safe steps.
SETTINGS: Mapping[str, Any] = {
    "n_envs": 16,
    "n_steps": 64,
    "batch_size": 256,
    "n_epochs": 5,
    "ent_coef": 0.0,
    "target_kl": 0.02,
    "meta_update": False,
    "inner_updates": 1,
    "scale_rewards": True,
}
LEARNING_RATE = 3e-3
#: Deviation of actions at the start and at the end, as a share of half their range.
NOISE = (0.1, 0.02)


class _Gradients:
    """Keeps zeros zero and tied numbers tied, by what it makes of the controllers' gradients.

    :param model: whose policy is a program
    :param program: that it started from
    :param symmetries: that tie its numbers
    """

    def __init__(self, model: ReptilePPO, program: ProgramData, symmetries: Sequence[Any]) -> None:
        self.model, self.program, self.symmetries = model, program, symmetries
        module: Any = model.policy.module
        self.rows, self.n_controllers = module.controllers_in_use, module.n_controllers
        self.mask = np.stack([matrix_of(controller) != 0 for controller in program.controllers])
        self.critic_alone_until = 0.0
        controllers = {module.controllers.weight, module.controllers.bias}
        for parameter in module.parameters():
            if parameter not in controllers:
                parameter.register_hook(th.zeros_like)  # conditions stay as they are
        module.controllers.weight.register_hook(lambda gradient: self._allowed(gradient, slice(None, -1)))
        module.controllers.bias.register_hook(lambda gradient: self._allowed(gradient[:, None], slice(-1, None))[:, 0])

    def _allowed(self, gradient: th.Tensor, columns: slice) -> th.Tensor:
        """Return the part of a gradient, ``(n_controllers * n_outputs, n_columns)``, that may be followed."""
        followed = th.zeros_like(gradient)
        if self.model.num_timesteps <= self.critic_alone_until:
            return followed
        given = gradient.unflatten(0, (self.n_controllers, -1))
        into = followed.unflatten(0, (self.n_controllers, -1))
        for row, mask in zip(self.rows, self.mask, strict=True):
            full = np.zeros(mask.shape)
            full[:, columns] = given[row].cpu().double().numpy()
            allowed = np.where(mask, symmetric_part(self.program, full, self.symmetries), 0.0)[:, columns]
            into[row] = th.as_tensor(allowed, dtype=gradient.dtype, device=gradient.device)
        return followed


def finetune(
    program: ProgramData,
    env_id: str,
    variations: Sequence[Mapping[str, Any]],
    symmetries: Sequence[Any],
    n_timesteps: int,
    seed: int,
) -> tuple[ProgramData, str]:
    """Train the numbers of a program's controllers that are not zero by PPO, on variations in turn.

    :param program: acts in a Box
    :param env_id: environment id
    :param variations: to train on
    :param symmetries: that tie its numbers; none for free ones
    :param n_timesteps: environment steps
    :param seed: of everything random
    :return: the program that comes of it, and how it was learned, as in ``learned_by``
    """
    stateless, around = not any(condition.remembers for condition in program.conditions), surroundings(program, env_id)
    model = ReptilePPO(
        "PRLPolicy" if stateless else "ProgPolicy",
        env_id,
        LinearSchedule(LEARNING_RATE, 0.0, 1.0),
        gamma=float(load_hyperparams("reptile_ppo", env_id).get("gamma", 0.99)),
        tasks=[{**around.variation, **variation} for variation in variations],
        env_kwargs=dict(around.kwargs),
        max_episode_steps=around.cap,
        interaction_history=program.interaction,
        init_program=Program(**vars(program)),
        action_std=_noise(program),
        seed=seed,
        device="cpu",
        **SETTINGS,
    )
    gradients = _Gradients(model, program, symmetries)
    gradients.critic_alone_until = CRITIC_FIRST * n_timesteps
    assert model.env is not None
    with contextlib.closing(model.env):
        learned = model.learn(n_timesteps).program()
    trained = [
        np.where(mask, symmetric_part(program, matrix_of(controller), symmetries), 0.0)
        for controller, mask in zip(learned.controllers, gradients.mask, strict=True)
    ]
    return with_controllers(program, trained), model.learned_by


def why_not(program: ProgramData) -> str | None:
    """Return why a program cannot be trained on, in a sentence; ``None`` if it can.

    :param program: well formed
    """
    try:
        read_initial_program(program)
    except ValueError as error:
        return str(error).removeprefix("init_program: ")
    return None


def _noise(program: ProgramData) -> LinearSchedule:
    """Return the deviation of actions: it ends near what is run, which has none."""
    half = (np.array(program.action.high) - np.array(program.action.low)) / 2
    scale = float(min(half[np.isfinite(half) & (half > 0)], default=1.0))
    return LinearSchedule(NOISE[0] * scale, NOISE[1] * scale, 1.0)


def matrix_of(controller: Controller) -> Floats:
    """Return weights and constant of a controller, ``(n_outputs, n_inputs + 1)``."""
    return np.column_stack([np.array(controller.weights), np.array(controller.bias)])


def with_controllers(program: ProgramData, matrices: Sequence[Floats]) -> ProgramData:
    """Return a program with other controllers.

    :param program: whose conditions stay
    :param matrices: weights and constant of each controller, ``(n_outputs, n_inputs + 1)``
    """
    return with_branches(program, dict(enumerate(matrices)))


def with_branches(
    program: ProgramData, matrices: Mapping[int, Floats], conditions: Mapping[int, Condition] | None = None
) -> ProgramData:
    """Return a program of some of a program's branches, with other controllers.

    :param program: the original
    :param matrices: weights and constant of controllers, ``(n_outputs, n_inputs + 1)``, by the index of the branch
    :param conditions: in place of the original's, by index; all others stay
    """
    *others, last = sorted(matrices)
    body: Expression = _controller(matrices[last])
    for index in reversed(others):
        condition = (conditions or {}).get(index, program.conditions[index])
        body = IfThenElse(condition, _controller(matrices[index]), body)
    return dataclasses.replace(program, body=body)


def _controller(matrix: Floats) -> Controller:
    return Controller(tuple(map(tuple, matrix[:, :-1].tolist())), tuple(matrix[:, -1].tolist()))
