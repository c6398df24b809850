"""How well a program or a model does on variations of a domain: success, steps, and the planner's steps."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_wrapper

from progpolicy_envs import find_domain
from sb3_progpolicy.bounds import check_whole
from sb3_progpolicy.env_ids import env_to_act_in, spec_of
from sb3_progpolicy.extraction import extract_program, holds_program, wrappers_of
from sb3_progpolicy.interaction import VecInteractionHistory
from sb3_progpolicy.programs.interpreter import ProgramRunner, Semantics, join_inputs
from sb3_progpolicy.programs.syntax import ProgramData
from sb3_progpolicy.reptile.options import ReadOptions, constructor_arguments, refuse_starts, refuse_unread
from sb3_progpolicy.spaces import action_spec, interaction_space, shaped
from sb3_progpolicy.surroundings import check_fit, own_env_kwargs, refuse_wrappers
from sb3_progpolicy.vec_env import BatchedVecEnv, make_fast_vec_env
from sb3_progpolicy.vec_env.repeat import repeat_options

Act = Callable[[NDArray[Any], NDArray[np.float32], NDArray[np.bool_]], NDArray[Any]]


@dataclass(frozen=True)
class Evaluation:
    """Results on one variation.

    :param env: environment id
    :param variation: the parameters that were set
    :param episodes: number of episodes
    :param success_rate: share of them that reached the goal, 0 to 1; ``None`` where the environment has no goal, that
        is, reports no ``is_success``
    :param steps_mean: mean steps to the goal; an episode that fails counts as the cap, as in the paper. Where there is
        no goal, the mean length of an episode
    :param steps_std: their standard deviation
    :param optimal_steps_mean: mean steps of the domain's planner on the same episodes; ``None`` where there is none
    :param semantics: ``"soft"`` or ``"crisp"``; ``None`` for a model that is not a program
    :param return_mean: mean sum of an episode's rewards, not discounted
    :param return_std: their standard deviation
    """

    env: str
    variation: Mapping[str, Any]
    episodes: int
    success_rate: float | None
    steps_mean: float
    steps_std: float
    optimal_steps_mean: float | None
    semantics: Semantics | None
    return_mean: float
    return_std: float

    @property
    def ratio(self) -> float | None:
        """Steps as a multiple of the planner's, 1 at best; ``None`` where there is no planner."""
        return self.steps_mean / self.optimal_steps_mean if self.optimal_steps_mean else None

    def to_json(self) -> dict[str, Any]:
        """Return the fields as JSON values."""
        return cast(dict[str, Any], _as_json(dataclasses.asdict(self)))


def evaluate_program(
    program: ProgramData,
    env_id: str | None = None,
    variations: Sequence[Mapping[str, Any]] = ({},),
    n_episodes: int = 1,
    semantics: Semantics = "crisp",
    seed: int = 0,
    max_steps: int | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    watch: Callable[[NDArray[np.float64], NDArray[np.int64]], None] | None = None,
) -> list[Evaluation]:
    """Run a program on variations of an environment.

    Its memory is zero at the start of a variation, which is a task, and is kept across the episodes of that variation
    (section 2.4).

    :param program: what to evaluate
    :param env_id: environment id; by default the one in the program's metadata
    :param variations: parameters to set, one mapping for each row of the result; with parts of a start, such as
        ``discs``, for one episode alone
    :param n_episodes: episodes on each variation, at least 1
    :param semantics: ``"crisp"`` or ``"soft"``
    :param seed: variation ``i`` is seeded with ``seed + i``
    :param max_steps: cap of an episode in place of the registered one
    :param env_kwargs: constructor arguments common to all variations; by default those in the program's metadata, if it
        is its environment
    :param watch: is called at each step with X ``(n_envs, n_inputs)`` and the index of the branch taken ``(n_envs,)``
    :return: one row for each variation
    :raises ValueError: if an argument is not accepted or the program does not fit the environment
    """
    if env_kwargs is None:
        env_kwargs = own_env_kwargs(program, env_id)
    env_id = env_to_act_in(env_id, program.metadata.get("env"), "the program")
    refuse_wrappers("the program", program.metadata.get("wrappers", ()))

    def start(venv: VecEnv) -> Act:
        check_fit(program, env_id, venv.observation_space, venv.action_space)
        runner = ProgramRunner(program, venv.num_envs, semantics)
        previous: NDArray[Any] | None = None

        def act(observations: NDArray[Any], rewards: NDArray[np.float32], dones: NDArray[np.bool_]) -> NDArray[Any]:
            nonlocal previous
            inputs = join_inputs(program, observations, previous, rewards, dones)
            previous = runner.act(inputs)
            if watch is not None:
                watch(inputs, runner.branch)
            return shaped(previous, venv.action_space)

        return act

    return _evaluate(env_id, variations, n_episodes, semantics, seed, max_steps, env_kwargs, lambda venv: venv, start)


def evaluate_model(
    model: BaseAlgorithm,
    env_id: str,
    variations: Sequence[Mapping[str, Any]] = ({},),
    n_episodes: int = 1,
    seed: int = 0,
    max_steps: int | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
) -> list[Evaluation]:
    """Run any SB3 model on variations of an environment, with its most likely actions.

    The state of a recurrent policy is zero at the start of a variation. It is kept across episodes where the model was
    trained so (:class:`~sb3_progpolicy.reptile_ppo.ReptilePPO`). A model whose observation space has room for the
    interaction history is given it.

    See :func:`evaluate_program` for the other arguments.
    """
    env = model.get_env()
    refuse_wrappers("the model", getattr(model, "wrappers", ()) if env is None else wrappers_of(env))
    normalizer = model.get_vec_normalize_env()

    def prepare(venv: VecEnv) -> VecEnv:
        assert model.observation_space is not None
        if model.action_space is not None and not _alike(model.action_space, venv.action_space):
            raise ValueError(f"the model acts in {model.action_space}; {env_id} has {venv.action_space}")
        outside = normalizer is not None and normalizer.observation_space.shape != venv.observation_space.shape
        if normalizer is not None and not outside:
            venv = _normalized(venv, normalizer)
        if venv.observation_space.shape == model.observation_space.shape:
            return venv
        joined = interaction_space(venv.observation_space, action_spec(venv.action_space))
        if joined.shape != model.observation_space.shape:
            raise ValueError(
                f"the model reads observations {model.observation_space.shape}; {env_id} has "
                f"{venv.observation_space.shape}, or {joined.shape} with the interaction history"
            )
        venv = VecInteractionHistory(venv)
        return _normalized(venv, normalizer) if normalizer is not None and outside else venv

    def start(venv: VecEnv) -> Act:
        state: Any = None

        def act(observations: NDArray[Any], rewards: NDArray[np.float32], dones: NDArray[np.bool_]) -> NDArray[Any]:
            nonlocal state
            actions, state = model.predict(observations, state, dones, deterministic=True)
            return actions

        return act

    return _evaluate(env_id, variations, n_episodes, None, seed, max_steps, env_kwargs, prepare, start)


def evaluate_any(
    model: BaseAlgorithm,
    env_id: str,
    variations: Sequence[Mapping[str, Any]] = ({},),
    n_episodes: int = 1,
    semantics: Sequence[Semantics] = ("soft", "crisp"),
    **arguments: Any,
) -> list[Evaluation]:
    """Run a model on variations of an environment: its program if it is one, in each of the semantics, else itself.

    See :func:`evaluate_program` and :func:`evaluate_model`.
    """
    if not holds_program(model):
        return evaluate_model(model, env_id, variations, n_episodes, **arguments)
    program = extract_program(model)
    return [
        row
        for kind in semantics
        for row in evaluate_program(program, env_id, variations, n_episodes, kind, **arguments)
    ]


def _alike(one: Any, other: Any) -> bool:
    """Return whether two action spaces are described alike, whatever their classes."""
    return one == other or (isinstance(one, type(other)) and action_spec(one) == action_spec(other))


def _normalized(venv: VecEnv, normalizer: VecNormalize) -> VecNormalize:
    """Normalise as a model's environment did when its training ended."""
    copy = VecNormalize(
        venv,
        training=False,
        norm_obs=normalizer.norm_obs,
        norm_reward=normalizer.norm_reward,
        clip_obs=normalizer.clip_obs,
        clip_reward=normalizer.clip_reward,
        epsilon=normalizer.epsilon,
        norm_obs_keys=normalizer.norm_obs_keys,
    )
    copy.ret_rms = normalizer.ret_rms
    if normalizer.norm_obs:
        copy.obs_rms = normalizer.obs_rms
    return copy


def _evaluate(
    env_id: str,
    variations: Sequence[Mapping[str, Any]],
    n_episodes: int,
    semantics: Semantics | None,
    seed: int,
    max_steps: int | None,
    env_kwargs: Mapping[str, Any] | None,
    prepare: Callable[[VecEnv], VecEnv],
    start: Callable[[VecEnv], Act],
) -> list[Evaluation]:
    check_whole("n_episodes", n_episodes, 1)
    check_whole("seed", seed, 0)
    if max_steps is not None:
        check_whole("max_steps", max_steps, 1)
    if not isinstance(env_id, str):
        raise ValueError(f"env_id={env_id!r} is not accepted; it is the id of an environment, such as 'CartPole-v1'")
    if isinstance(variations, (str, Mapping)) or not all(isinstance(one, Mapping) for one in variations):
        raise ValueError(
            f"variations={variations!r} is not accepted; it is a sequence of mappings, such as [{{'n_discs': 5}}]"
        )
    arguments = dict(env_kwargs or {})
    registered = arguments.pop("max_episode_steps", None)
    max_steps = registered if max_steps is None else max_steps
    spec = spec_of(env_id)
    cap = max_steps if max_steps is not None else spec.max_episode_steps
    if cap is None or cap < 1:
        raise ValueError(f"max_steps={max_steps} is not accepted; {env_id} needs a cap on steps of at least 1")
    if n_episodes > 1:
        refuse_starts(env_id, variations)
    rows: list[Evaluation] = []
    domain = find_domain(env_id)
    # In a batch those that have finished go on until the last has, which is expensive where a step is a simulation.
    batched = spec.vector_entry_point is not None and not (domain is not None and domain.simulation)
    # Parameters that a domain's environment reads as options are known; another's constructor may be where they go.
    by_constructor = (
        set().union(*(constructor_arguments(env_id, one, arguments) for one in _one_of_each_kind(variations)))
        if domain is None
        else set[str]()
    )
    for group in _groups(variations, batched and not by_constructor):
        first = len(rows)
        fixed = {name: value for name, value in group[0].items() if name in by_constructor}
        options = [{name: value for name, value in each.items() if name not in by_constructor} for each in group]
        venv = prepare(make_fast_vec_env(env_id, len(group), max_episode_steps=cap, **{**arguments, **fixed}))
        try:
            played = _play(venv, options, n_episodes, seed + first, cap, start(venv))
        finally:
            venv.close()
        success, steps, optimal = played.success, played.steps, played.optimal
        rows += [
            Evaluation(
                env=env_id,
                variation=dict(variation),
                episodes=n_episodes,
                success_rate=None if np.isnan(success[row]).any() else float(success[row].mean()),
                steps_mean=float(steps[row].mean()),
                steps_std=float(steps[row].std()),
                return_mean=float(played.returns[row].mean()),
                return_std=float(played.returns[row].std()),
                optimal_steps_mean=None if np.isnan(optimal[row]).any() else float(optimal[row].mean()),
                semantics=semantics,
            )
            for row, variation in enumerate(group)
        ]
    return rows


def _one_of_each_kind(variations: Sequence[Mapping[str, Any]]) -> Iterable[Mapping[str, Any]]:
    """Return one variation for each set of names."""
    return {frozenset(variation): variation for variation in variations}.values()


def _groups(variations: Sequence[Mapping[str, Any]], batched: bool) -> Iterator[list[Mapping[str, Any]]]:
    """Split into runs to be stepped together: alone, or, since a batch costs the same for all, by equal names."""
    if not batched:
        yield from ([variation] for variation in variations)
        return
    for _, group in groupby(variations, key=set):
        yield list(group)


@dataclass(frozen=True)
class _Played:
    """Episodes, each array ``(n_envs, n_episodes)``.

    :param success: 1 or 0; NaN where the environment reports none
    :param steps: to the goal, or the cap; the length of the episode where there is no goal
    :param returns: sums of rewards
    :param optimal: the planner's steps; NaN where there is none
    """

    success: NDArray[np.float64]
    steps: NDArray[np.float64]
    returns: NDArray[np.float64]
    optimal: NDArray[np.float64]


def _play(
    venv: VecEnv, variations: Sequence[Mapping[str, Any]], n_episodes: int, seed: int, cap: int, act: Act
) -> _Played:
    """Play ``n_episodes`` in every environment.

    An environment that has played its episodes goes on, unrecorded, until the last has.
    """
    n_envs = venv.num_envs
    success = np.full((n_envs, n_episodes), np.nan)
    steps, returns = np.full((n_envs, n_episodes), float(cap)), np.zeros((n_envs, n_episodes))
    optimal = np.full((n_envs, n_episodes), np.nan)
    venv.seed(seed)
    given = [ReadOptions(variation) for variation in variations]
    if any(variations):
        repeat_options(venv)
    venv.set_options(list(given))
    observations: Any = venv.reset()
    refuse_unread(given, "the environment")
    optimal[:, 0] = _optimal_steps(venv)
    normalizer = unwrap_vec_wrapper(venv, VecNormalize)
    rewards, dones = np.zeros(n_envs, dtype=np.float32), np.zeros(n_envs, dtype=bool)
    finished, elapsed = np.zeros(n_envs, dtype=np.int64), np.zeros(n_envs, dtype=np.int64)
    earned = np.zeros(n_envs)
    while (finished < n_episodes).any():
        observations, rewards, dones, infos = venv.step(act(observations, rewards, dones))
        elapsed += 1
        earned += rewards if normalizer is None else normalizer.get_original_reward()
        ended = np.flatnonzero(dones & (finished < n_episodes))
        for row in ended:
            reached = infos[row].get("is_success")
            if reached is not None:
                success[row, finished[row]] = bool(reached)
            if reached or reached is None:
                steps[row, finished[row]] = elapsed[row]
            returns[row, finished[row]] = earned[row]
        finished[ended] += 1
        elapsed[dones], earned[dones] = 0, 0.0
        if going_on := [row for row in ended if finished[row] < n_episodes]:
            planned = _optimal_steps(venv)
            optimal[going_on, finished[going_on]] = planned[going_on]
    return _Played(success, steps, returns, optimal)


def success_and_steps(rows: Sequence[Evaluation]) -> tuple[float, float]:
    """Return the mean success and the mean steps over several variations.

    :raises ValueError: if the environment has no goal
    """
    rates = [row.success_rate for row in rows if row.success_rate is not None]
    if len(rates) < len(rows):
        raise ValueError(
            f"{rows[0].env} is not accepted here; it does not report is_success, whether a goal is reached"
        )
    return float(np.mean(rates)), float(np.mean([row.steps_mean for row in rows]))


def _optimal_steps(venv: VecEnv) -> NDArray[np.float64]:
    """The planner's steps from the states in which episodes have just begun; meaningless in the middle of one."""
    if isinstance(venv.unwrapped, BatchedVecEnv) and venv.has_attr("optimal_steps"):
        return np.asarray(venv.env_method("optimal_steps")[0], dtype=np.float64)
    infos = venv.unwrapped.reset_infos  # SB3's wrappers do not pass them on
    return np.array([info.get("optimal_steps", np.nan) for info in infos], dtype=np.float64)


def _as_json(value: Any) -> Any:
    """Return NumPy's numbers and arrays as Python's, in mappings and sequences too."""
    if isinstance(value, Mapping):
        return {str(key): _as_json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_as_json(item) for item in value]
    return value.tolist() if isinstance(value, (np.generic, np.ndarray)) else value
