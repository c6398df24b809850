"""What a program does from every start that a variation has, or from some where they cannot be counted."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from progpolicy_envs import find_domain
from sb3_progpolicy.analysis.checkpoint import Checkpoint
from sb3_progpolicy.analysis.rollout import make_batch, run_episodes, start_numbers
from sb3_progpolicy.env_ids import env_to_act_in, spec_of
from sb3_progpolicy.programs.interpreter import ProgramRunner, join_inputs
from sb3_progpolicy.programs.io import program_digest
from sb3_progpolicy.programs.syntax import ProgramData
from sb3_progpolicy.reptile.options import ReadOptions, refuse_unread, split_variation
from sb3_progpolicy.spaces import shaped
from sb3_progpolicy.surroundings import check_fit, own_env_kwargs, refuse_wrappers, surroundings

#: Numbers of starts: all of them, or those drawn.
Numbers = range | NDArray[np.int64]
BATCH = 8192
#: Starts that are gone through one by one, at most; where there are more, some are drawn.
MAX_STARTS = 10_000_000
#: Starts that are drawn where a variation has too many, or they cannot be counted.
N_DRAWN = 1000
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Verification:
    """What a program does on one variation.

    :param variation: the parameters that were set
    :param starts: how many starts were tried
    :param solved: from how many of them the goal was reached
    :param optimal: from how many in the fewest steps; ``None`` where there is no planner
    :param worst_ratio: largest ratio of steps to the planner's, of those solved; ``None`` where there is no planner
    :param exhaustive: whether these are all starts
    :param success_bound: lower bound on the share of starts that are solved (Clopper and Pearson, one-sided, 95 %);
        ``None`` where all were tried
    :param counterexample: options (and, where the start is drawn, the seed) of the reset of the shortest start that
        fails; ``None`` where none does
    """

    variation: Mapping[str, Any]
    starts: int
    solved: int
    optimal: int | None
    worst_ratio: float | None
    exhaustive: bool
    success_bound: float | None
    counterexample: Mapping[str, Any] | None

    def to_json(self) -> dict[str, Any]:
        """Return the fields as JSON values."""
        return dataclasses.asdict(self)


def verify(
    program: ProgramData,
    env_id: str | None = None,
    variations: Sequence[Mapping[str, Any]] | None = None,
    *,
    from_any_state: bool = False,
    all_starts: bool = False,
    n_starts: int | None = None,
    max_steps: int | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
) -> list[Verification]:
    """Run the crisp program once from every start of each variation, its memory being empty.

    The environment is made with the arguments that the program was trained with, as its metadata say, if it is the
    program's own.

    In the planning domains starts can be counted: pairs of pegs, places of plates and gripper, sets of stars. Where
    they cannot, or there are more than :data:`MAX_STARTS`, a number of them is drawn, and the share of those that are
    solved has a bound. A bound is a test, and not a proof.

    :param program: what to verify
    :param env_id: environment id; by default the one in the program's metadata
    :param variations: parameters to set; by default those that the domain is trained on. What is not given has all its
        values where it may be random
    :param from_any_state: begin in all legal states, whether or not episodes begin there (Hanoi)
    :param all_starts: go through all starts, however many there are
    :param n_starts: draw this number of starts of each variation, if it has more
    :param max_steps: cap on the steps of an episode in place of the registered one; an optimal solution always fits
    :param seed: of the draw
    :param progress: is called with the number of starts done and that of all of a variation
    :param checkpoint: file in which the counts are kept; one that exists is gone on from, with the same arguments
    :return: one row for each variation
    :raises ValueError: if an argument is not accepted, the program does not fit, the environment has no goal, or the
        file is of another verification
    """
    env_id = env_to_act_in(env_id, program.metadata.get("env"), "the program")
    if all_starts and n_starts is not None:
        raise ValueError(f"all_starts and n_starts={n_starts} are not accepted together")
    if n_starts is not None and n_starts < 1:
        raise ValueError(f"n_starts={n_starts} is not accepted; it is at least 1")
    refuse_wrappers("the program", program.metadata.get("wrappers", ()))
    domain = find_domain(env_id)
    if variations is None:
        variations = [{}] if domain is None else domain.trained
    rng = np.random.default_rng(seed)
    given = {"from_any_state": from_any_state, "all_starts": all_starts, "n_starts": n_starts, "max_steps": max_steps}
    around = surroundings(program, env_id)
    listed = [{**around.variation, **variation} for variation in variations]
    origin: dict[str, Any] = {
        "program": program_digest(program),
        "env": env_id,
        "variations": listed,
        **given,
        "seed": seed,
    }
    if own := own_env_kwargs(program, env_id):
        origin["env_kwargs"] = own
    kept = Checkpoint(None if checkpoint is None else Path(checkpoint), origin)
    rows = [Verification(**row) for row in kept.rows]
    for place, variation in enumerate(listed):
        counted = _count(program, env_id, variation, from_any_state)
        if counted is None:
            if all_starts:
                raise ValueError(f"all_starts is not accepted for {env_id} {dict(variation)}; they cannot be counted")
            drawn, first_seed = N_DRAWN if n_starts is None else n_starts, int(rng.integers(2**31))
            if place < len(kept.rows):
                continue
            rows.append(_sampled(program, env_id, variation, drawn, max_steps, first_seed, progress))
        else:
            limit = n_starts if all_starts or n_starts is not None or counted <= MAX_STARTS else N_DRAWN
            numbers: Numbers = range(counted)
            if limit is not None and counted > limit:
                numbers = start_numbers(counted, limit, rng)
            if place < len(kept.rows):
                continue
            rows.append(
                _counted(program, env_id, variation, numbers, counted, from_any_state, max_steps, progress, kept)
            )
        kept.row(rows[-1].to_json())
    return rows


def _count(program: ProgramData, env_id: str, variation: Mapping[str, Any], any_state: bool) -> int | None:
    domain = find_domain(env_id)
    if domain is None or domain.simulation or not domain.vector_entry_point:
        if any_state:
            raise ValueError(f"{env_id}: its legal states cannot be counted; leave out from_any_state")
        return None
    venv = make_batch(program, env_id, 1)
    try:
        return venv.count_starts(variation, any_state)
    except ValueError as error:
        if any_state or "cannot be counted" not in str(error):
            raise
        return None


def _counted(
    program: ProgramData,
    env_id: str,
    variation: Mapping[str, Any],
    numbers: Numbers,
    count: int,
    any_state: bool,
    max_steps: int | None,
    progress: Callable[[int, int], None] | None,
    kept: Checkpoint,
) -> Verification:
    tally = _Tally()
    vars(tally).update(kept.counts)
    venv, registered = make_batch(program, env_id, min(BATCH, len(numbers))), surroundings(program, env_id).cap or 0
    for first in range(tally.starts, len(numbers), BATCH):
        part = np.asarray(numbers[first : first + BATCH], dtype=np.int64)
        if len(part) != venv.num_envs:
            venv = make_batch(program, env_id, len(part))
        observations = venv.reset_to(variation, part, any_state)
        optimal = venv.optimal_steps()
        cap = max_steps or max(registered, 2 * int(optimal.max()))
        steps = run_episodes(program, venv, observations, optimal, cap)
        shortest = tally.add(steps, optimal.astype(np.float64))
        if shortest is not None:
            one = make_batch(program, env_id, 1)
            one.reset_to(variation, part[shortest : shortest + 1], any_state)
            tally.counterexample = {"options": one.state_of(0)}
        kept.count(vars(tally))
        if progress is not None:
            progress(tally.starts, len(numbers))
    return tally.row(variation, exhaustive=len(numbers) == count)


def _sampled(
    program: ProgramData,
    env_id: str,
    variation: Mapping[str, Any],
    n_starts: int,
    max_steps: int | None,
    seed: int,
    progress: Callable[[int, int], None] | None,
) -> Verification:
    """Run a program in single environments, each episode from a seed of its own."""
    around, spec = surroundings(program, env_id), spec_of(env_id)
    cap = around.cap if max_steps is None else max_steps
    if cap is None:
        raise ValueError(f"{env_id} has no cap on the steps of an episode; give max_steps")
    fixed, options = split_variation(env_id, variation, around.kwargs)
    tally = _Tally()
    env = gym.make(spec.id, **{**around.kwargs, **fixed, "max_episode_steps": cap})
    try:
        check_fit(program, env_id, env.observation_space, env.action_space)
        for number in range(n_starts):
            read = ReadOptions(options)
            observation, info = env.reset(seed=seed + number, options=read if options else None)
            if options:
                refuse_unread([read], env_id)
            optimal = info.get("optimal_steps")
            steps = _steps_to_goal(program, env, env_id, observation)
            failed = tally.add(np.array([steps]), np.array([np.nan if optimal is None else optimal]))
            if failed is not None:
                tally.counterexample = {"seed": seed + number, "options": dict(variation)}
            if progress is not None:
                progress(tally.starts, n_starts)
    finally:
        env.close()
    return tally.row(variation, exhaustive=False)


def _steps_to_goal(program: ProgramData, env: gym.Env[Any, Any], env_id: str, observation: Any) -> int:
    """Return in how many steps the goal is reached, -1 if the episode ends before."""
    runner, previous, reward, step = ProgramRunner(program), None, 0.0, 0
    while True:
        flat = np.asarray(observation, dtype=np.float64).reshape(1, -1)
        previous = runner.act(join_inputs(program, flat, previous, reward, False))
        action = shaped(previous, env.action_space)[0]
        observation, reward, terminated, truncated, info = env.step(action)  # type: ignore[assignment]
        step += 1
        if info.get("is_success", False):
            return step
        if terminated or truncated:
            if "is_success" not in info:
                raise ValueError(f"{env_id} does not say whether its goal is reached; evaluate measures returns")
            return -1


class _Tally:
    """Counts how episodes ended."""

    def __init__(self) -> None:
        self.starts = self.solved = self.n_optimal = 0
        self.has_planner = True
        self.worst: float | None = None
        self.shortest: float | None = None  # optimal steps of the counterexample
        self.counterexample: dict[str, Any] | None = None

    def add(self, steps: NDArray[np.int64], optimal: NDArray[np.float64]) -> int | None:
        """Count episodes.

        :param steps: -1 where the goal was not reached
        :param optimal: fewest steps; NaN where there is no planner
        :return: the place of the shortest one that fails, if it is shorter than those before
        """
        reached = steps >= 0
        self.starts += len(steps)
        self.solved += int(reached.sum())
        if np.isnan(optimal).any():
            self.has_planner = False
        else:
            self.n_optimal += int((steps == optimal).sum())
            ratios = steps[reached & (optimal > 0)] / optimal[reached & (optimal > 0)]
            if len(ratios):
                self.worst = max(float(ratios.max()), self.worst or 0.0)
        failed = np.flatnonzero(~reached)
        if not len(failed):
            return None
        lengths = np.nan_to_num(optimal[failed], nan=1e9)
        if self.shortest is not None and lengths.min() >= self.shortest:
            return None
        self.shortest = float(lengths.min())
        return int(failed[lengths.argmin()])

    def row(self, variation: Mapping[str, Any], exhaustive: bool) -> Verification:
        """Return what was counted."""
        return Verification(
            variation=dict(variation),
            starts=self.starts,
            solved=self.solved,
            optimal=self.n_optimal if self.has_planner else None,
            worst_ratio=self.worst if self.has_planner else None,
            exhaustive=exhaustive,
            success_bound=None if exhaustive else success_bound(self.solved, self.starts),
            counterexample=self.counterexample,
        )


def success_bound(solved: int, starts: int, confidence: float = CONFIDENCE) -> float:
    """Return the one-sided lower bound of Clopper and Pearson (1934) on a share.

    :param solved: successes
    :param starts: trials
    :param confidence: 0 to 1
    """
    from scipy.stats import beta

    return 0.0 if solved == 0 else float(beta.ppf(1 - confidence, solved, starts - solved + 1))


def certificate(program: ProgramData, env_id: str, rows: Sequence[Verification], command: str) -> dict[str, Any]:
    """Return rows with what they are about, as JSON values.

    :param program: that was verified
    :param env_id: in which environment
    :param rows: from :func:`verify`
    :param command: that reproduces them
    """
    from importlib.metadata import version

    own = own_env_kwargs(program, env_id)
    return {
        "program": program_digest(program),
        "env": env_id,
        **({"env_kwargs": own} if own else {}),
        "command": command,
        "versions": {name: version(name) for name in ("sb3-progpolicy", "gymnasium", "numpy")},
        "rows": [row.to_json() for row in rows],
    }
