"""Training that starts from a program: what ``ReptilePPO(init_program=...)`` does with it."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_wrapper

from sb3_progpolicy.differentiable.initial import put_program, shape_of
from sb3_progpolicy.interaction import appends_history
from sb3_progpolicy.names import check_ignored
from sb3_progpolicy.normalization import NormalizingExtractor
from sb3_progpolicy.policies import ProgrammaticActorCritic
from sb3_progpolicy.pretrained import load_pretrained
from sb3_progpolicy.programs.program import LEARNED_BY, Program, load_program
from sb3_progpolicy.programs.syntax import IfThenElse, ProgramData
from sb3_progpolicy.programs.validation import check_program

#: Temperature at the start, for conditions whose largest weight is 1.
TEMPERATURE = 1e-5
#: Deviation of Box actions at the start, as a share of half their range; of the unit where they have no bounds.
ACTION_STD = 0.1


def read_initial_program(given: ProgramData | str | os.PathLike[str] | None) -> Program | None:
    """Return the program that ``init_program`` stands for.

    :param given: a program, its ``.json`` file, a run folder or the name of a shipped program
    :raises ValueError: if there is none, or it is not a chain of if-then-else with conditions of one kind
    """
    if given is None:
        return None
    program = given if isinstance(given, ProgramData) else _find(given)
    for branch in _branches(program):
        if isinstance(branch.then, IfThenElse):
            raise ValueError("init_program: a condition inside a then-branch is not accepted; those in else are")
    try:
        check_program(program)
        if any(condition.cell == "switch" for condition in program.conditions):
            raise ValueError("a switch has no gradient, so that training cannot start from it")
        shape_of(program)
    except ValueError as error:
        raise ValueError(f"init_program: {error}") from None
    return Program(**vars(program))


def _find(given: Any) -> Program:
    if not isinstance(given, (str, os.PathLike)):
        raise ValueError(
            f"init_program={type(given).__name__} is not accepted; give a Program, its .json file, a run folder or the "
            "name of a shipped program"
        )
    path = Path(given)
    path = path / "program.json" if path.is_dir() else path
    if path.is_file():
        return load_program(path)
    if path.suffix == ".json" or isinstance(given, os.PathLike):
        raise ValueError(f"init_program={os.fspath(path)!r} is not accepted; there is no such file")
    return load_pretrained(os.fspath(given))


def _branches(program: ProgramData) -> list[IfThenElse]:
    branches, expression = [], program.body
    while isinstance(expression, IfThenElse):
        branches.append(expression)
        expression = expression.orelse
    return branches


def complete_policy_kwargs(
    given: Mapping[str, Any],
    policy: type[BasePolicy],
    program: Program | None,
    normalize_observations: bool,
    interaction_history: bool,
    ignore: Sequence[str] = (),
    input_names: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Return the arguments of a new model's policy: the user's and those that the model's own arguments ask for.

    :param given: the user's ``policy_kwargs``
    :param policy: class of the policy
    :param program: from :func:`read_initial_program`
    :param normalize_observations: whether the policy normalises what it reads
    :param interaction_history: whether the history is appended to observations
    :param ignore: names of inputs that are not to be read
    :param input_names: of all inputs; ``None`` where they are not known, as in loading, when the arguments are
    :raises ValueError: if they do not go together
    """
    if given.get("persistence_init") and not interaction_history:
        raise ValueError(
            f"persistence_init={given['persistence_init']} is not accepted with interaction_history=False; the policy "
            "then does not see its previous action"
        )
    if given.get("reset_state_at_episode_start"):
        raise ValueError(
            "reset_state_at_episode_start=True is not accepted; in ReptilePPO states survive the end of an episode and "
            "are zeroed at a task switch only (section 2.4)"
        )
    completed = dict(given)
    if normalize_observations:
        completed.setdefault("features_extractor_class", NormalizingExtractor)
    if ignore and input_names is not None:
        check_ignored(ignore, input_names)
        if completed.get("features_extractor_class") is not NormalizingExtractor:
            raise ValueError(f"ignore={tuple(ignore)} is not accepted with normalize_observations=False")
        ignored = [index for index, name in enumerate(input_names) if name in ignore]
        completed["features_extractor_kwargs"] = {**completed.get("features_extractor_kwargs", {}), "ignored": ignored}
    return completed if program is None else initial_policy_kwargs(program, policy, completed)


def initial_policy_kwargs(program: Program, policy: type[BasePolicy], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of the policy that can be the program; those given are kept, but for how many conditions.

    :param program: from :func:`read_initial_program`
    :param policy: class of the policy
    :param given: the user's ``policy_kwargs``
    :raises ValueError: if the policy is not a program, normalises what it reads or is tied over symmetries
    """
    if not issubclass(policy, ProgrammaticActorCritic):
        raise ValueError(f"init_program is not accepted with {policy.__name__}; ProgPolicy and PRLPolicy are programs")
    if given.get("features_extractor_class") is NormalizingExtractor:
        raise ValueError(
            "init_program is not accepted with normalize_observations=True; the program reads raw numbers, and "
            "statistics that move with training would change what it does. Leave the observations as they are"
        )
    if given.get("symmetries"):
        raise ValueError(
            "init_program is not accepted with symmetric=True; its weights need not be tied. Give symmetric=False"
        )
    shape = shape_of(program)
    fitting: dict[str, Any] = {"temperature": _temperature(program)}
    if shape is not None:
        fitting |= {"cell": shape[0], "condition_size": shape[1]}
    if given.get("n_conditions") is not None:  # as hyperparameters for training from the start have it
        fitting["n_conditions"] = len(program.conditions)
        given = {name: value for name, value in given.items() if name != "n_conditions"}
    return {**fitting, **given, "depth": max(len(program.conditions) + 1, given.get("depth", 1))}


def _temperature(program: Program) -> float:
    """Return the temperature at which conditions are as good as decided, by the size of their weights."""
    sizes = [
        max(map(abs, weights))
        for condition in program.conditions
        for weights in ((condition.readout,) if condition.remembers else condition.rows)
    ]
    return TEMPERATURE * min((size for size in sizes if size), default=1.0)


def start_from_program(model: Any, program: Program) -> str:
    """Let a new model's policy be a program, with little noise unless the user has said how much.

    :param model: a ReptilePPO, set up
    :param program: from :func:`read_initial_program`
    :return: how what the model learns will have been learned, for ``learned_by``
    :raises ValueError: if the program does not fit the environments or the policy
    """
    if model.env is None:
        raise ValueError("init_program is not accepted without an environment")
    _check_inputs(model, program)
    try:
        put_program(model.policy.module, program)
    except ValueError as error:
        raise ValueError(f"init_program: {error}") from None
    if hasattr(model.policy, "log_std") and "log_std_init" not in model.policy_kwargs:
        with th.no_grad():
            model.policy.log_std.copy_(_log_std(model.policy.spec_of_actions))
    imitated = program.learned_by in ("imitation", "imitation+reinforcement")
    return LEARNED_BY[2] if imitated else LEARNED_BY[0]


def _check_inputs(model: Any, program: Program) -> None:
    env: VecEnv = model.env
    normalizer = unwrap_vec_wrapper(env, VecNormalize)
    if isinstance(normalizer, VecNormalize) and normalizer.norm_obs:
        raise ValueError(
            "init_program is not accepted with VecNormalize of observations; the program reads raw numbers"
        )
    spec, interaction = model.policy.spec_of_actions, appends_history(env)
    if (program.action.kind, program.action.sizes) != (spec.kind, spec.sizes):
        raise ValueError(
            f"init_program acts in {program.action.kind} {program.action.sizes}, which is not accepted; the "
            f"environment's actions are {spec.kind} {spec.sizes}"
        )
    if (program.action.low, program.action.high, program.action.start) != (spec.low, spec.high, spec.start):
        raise ValueError("init_program has other bounds of its actions than the environment, which is not accepted")
    if program.interaction and not interaction:
        raise ValueError(
            "init_program reads its previous action, reward and done flag, which the policy does not see; give "
            "interaction_history=True"
        )
    n_observations = model.policy.module.n_inputs - (spec.interaction_size if interaction else 0)
    if program.n_observations != n_observations:
        raise ValueError(
            f"init_program reads observations of {program.n_observations} numbers, which is not accepted; the "
            f"environment's have {n_observations}"
        )
    read = (program.input_names[:n_observations], program.output_names)
    given = ((model.input_names or ())[:n_observations], model.output_names or ())
    for what, names, expected in zip(("inputs", "outputs"), read, given, strict=True):
        other = [(name, right) for name, right in zip(names, expected, strict=True) if name != right]
        if other:
            warnings.warn(
                f"init_program names {len(other)} of its {what} in another way than the environment (the first: "
                f"{other[0][0]!r} is {other[0][1]!r}); they are taken in their order",
                stacklevel=2,
            )


def _log_std(spec: Any) -> th.Tensor:
    half = (np.array(spec.high) - np.array(spec.low)) / 2
    return th.tensor([math.log(ACTION_STD * (size if np.isfinite(size) and size > 0 else 1.0)) for size in half])
