"""Growth: the number of conditions, found by trying one more at a time and keeping what pays.

The structure of a program is not in the gradient's path here. A new condition is put where it changes nothing at first
(:mod:`~sb3_progpolicy.differentiable.growth`), is trained for a while beside a twin without it, on the same tasks, and
stays only if the return is then higher by more than its price.
"""

from __future__ import annotations

import contextlib
import copy
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, get_args

import numpy as np
import torch as th

from sb3_progpolicy.bounds import check_number, check_whole
from sb3_progpolicy.differentiable.growth import divide
from sb3_progpolicy.nearest import unknown
from sb3_progpolicy.reptile.callback import start_task
from sb3_progpolicy.reptile.statistics import EpisodeStatistics
from sb3_progpolicy.reptile_ppo.divisions import MAX_STATES, Experience, rank_divisions, tries
from sb3_progpolicy.reptile_ppo.inner_loops import Learning
from sb3_progpolicy.reptile_ppo.returns import Comparison, episode_returns
from sb3_progpolicy.reptile_ppo.rollout import states_of
from sb3_progpolicy.reptile_ppo.theta import Theta

SearchMethod = Literal["gradient", "growth"]
#: In the place of an inner loop's number in a meta-batch: what else is drawn for the same meta-iteration.
LOOK, COMPARE = 2**31, 2**31 + 1
#: Least number of states that are looked at.
MIN_LOOK = 1024
#: A trial that has not decided goes on until it was compared so often.
MAX_ROUNDS = 3


def check_search_arguments(search_method: str, search_fraction: float, growth_iterations: int) -> None:
    """Raise ``ValueError`` for a value that is not accepted."""
    check_number("search_fraction", search_fraction)
    if search_method not in get_args(SearchMethod):
        raise unknown("search_method", search_method, get_args(SearchMethod))
    check_whole("growth_iterations", growth_iterations, 1)


def begin_growth(model: Any) -> Growth:
    """Let a new model's program be the shortest one, or the one that it starts from.

    :param model: a ReptilePPO, set up
    :raises ValueError: if its policy is not a program, or has no condition that could be added
    """
    if model.search is None:
        raise ValueError(
            f"search_method='growth' is not accepted with {type(model.policy).__name__}; ProgPolicy and PRLPolicy are "
            "programs"
        )
    if model.policy.n_conditions is not None:
        raise ValueError(
            f"search_method='growth' is not accepted with n_conditions={model.policy.n_conditions}, which fixes the "
            "program; depth gives the most conditions, plus 1"
        )
    if model.policy.module.conditions.cell == "min":
        raise ValueError("search_method='growth' is not accepted with conditions of several sums (cell='min')")
    if model.policy.module.depth < 2:
        raise ValueError("search_method='growth' is not accepted with depth=1, which has room for no condition")
    if model.search.searching:
        model.search.select(0)
    return Growth()


@dataclass(frozen=True)
class Arm:
    """One of the two programs of a trial, with all that its training goes on from.

    :param theta: parameters, moments, statistics
    :param meta_optimizer: state of the meta-optimizer
    """

    theta: Theta
    meta_optimizer: dict[str, Any]

    @classmethod
    def of(cls, model: Any) -> Arm:
        """Copy what a model holds."""
        return cls(Theta.of(model), copy.deepcopy(model.outer_optimizer.state_dict()))

    def put_into(self, model: Any) -> None:
        """Give it to a model, whose clock goes on."""
        now = {"num_timesteps": model.num_timesteps, "total_timesteps": model._total_timesteps}
        replace(self.theta, **now).put_into(model)
        model.outer_optimizer.load_state_dict(copy.deepcopy(self.meta_optimizer))


@dataclass
class Growth:
    """The state of a growing program between two meta-iterations. The model itself holds the program without the trial.

    :param waited: meta-iterations since the last trial ended, or since the open one began or was last compared
    :param rounds: how often the open trial was compared
    :param refused: conditions taken back in a row
    :param arm: the program with the condition that is being tried; ``None`` between trials
    :param trials: what was tried so far, as JSON values
    """

    waited: int = 0
    rounds: int = 0
    refused: int = 0
    arm: Arm | None = None
    trials: list[dict[str, Any]] = field(default_factory=list)

    def state(self) -> dict[str, Any]:
        """Return all but the parameters, as JSON values."""
        scaler = None if self.arm is None else self.arm.theta.reward_scaler
        return {
            "waited": self.waited,
            "rounds": self.rounds,
            "refused": self.refused,
            "trials": self.trials,
            "trial_is_open": self.arm is not None,
            "reward_statistics": scaler and scaler.state(),
        }

    def parameters(self) -> dict[str, Any]:
        """Return state dicts of the program that is being tried and of its optimizers, by name; none between trials."""
        if self.arm is None:
            return {}
        theta = self.arm.theta
        return {
            "policy": theta.policy,
            "policy.optimizer": theta.optimizer,
            "outer_optimizer": self.arm.meta_optimizer,
        }

    def restore(self, state: Mapping[str, Any], parameters: Mapping[str, Any] | None, model: Any) -> None:
        """Take over what :meth:`state` and :meth:`parameters` have returned.

        :param state: JSON values
        :param parameters: ``None`` between trials
        :param model: a ReptilePPO, whose parameters are restored already
        :raises ValueError: if it is something else
        """
        counts, trials = [state[name] for name in ("waited", "rounds", "refused")], state["trials"]
        if any(type(count) is not int or count < 0 for count in counts) or not isinstance(trials, list):
            raise ValueError(f"growth={state!r:.80} is not accepted; it holds counts and a list of trials")
        if any(not isinstance(trial, dict) or type(trial.get("kept")) is not bool for trial in trials):
            raise ValueError(f"growth: trials={trials!r:.80} is not accepted; each says whether a condition was kept")
        self.waited, self.rounds, self.refused = counts
        self.trials, self.arm = trials, None
        if parameters is None:
            return
        scaler = copy.deepcopy(model.reward_scaler)
        if scaler is not None:
            scaler.restore(state["reward_statistics"])
        clock = (model.num_timesteps, model._total_timesteps)
        theta = Theta(parameters["policy"], parameters["policy.optimizer"], scaler, *clock)
        self.arm = Arm(theta, parameters["outer_optimizer"])

    def goes_on(self, model: Any) -> bool:
        """Whether there is still something to try: a trial is open, or time and a layer are left for one."""
        left = 1 - model._current_progress_remaining < model.search_fraction
        return self.arm is not None or (left and model.search.most_likely() + 1 < model.policy.module.depth)

    def meta_iterate(self, model: Any, learning: Learning) -> None:
        """Make one meta-iteration: of the program, and of the one that is being tried, on the same tasks.

        :param model: a ReptilePPO
        :param learning: what its ``learn`` keeps
        """
        if self.arm is None and self.waited >= model.growth_iterations:
            self._begin_trial(model, learning)
        begun = model._begin_tasks()
        if model._goes_on(learning):
            model._reptile_step(copy.deepcopy(begun), learning)
        self.waited += 1
        if self.arm is not None:
            with self._other_arm(model):
                if model._goes_on(learning):
                    model._reptile_step(begun, learning)
            if self.waited >= model.growth_iterations and not learning.stopped:
                self._compare(model, learning)
        model.logger.record("growth/n_conditions", model.search.most_likely())

    @contextlib.contextmanager
    def _other_arm(self, model: Any) -> Iterator[None]:
        """Let the model be the program that is being tried, for a while."""
        assert self.arm is not None
        mine = Arm.of(model)
        self.arm.put_into(model)
        try:
            yield
        finally:
            self.arm = Arm.of(model)
            mine.put_into(model)

    def _begin_trial(self, model: Any, learning: Learning) -> None:
        """Divide a branch in a copy of the program."""
        experience = look_around(model, learning)
        self.waited = self.rounds = 0  # not before: a checkpoint is made as it begins
        if experience is None:
            return
        chosen = tries(rank_divisions(model.policy, experience), self.refused)
        if chosen is None:
            warnings.warn(
                f"growth: at step {model.num_timesteps} there was nothing to divide; none of the last two branches was "
                "reached often enough, or what they read does not change",
                stacklevel=2,
            )
            return
        mine = Arm.of(model)
        divide(model.policy.module, chosen.division, model.policy.optimizer)
        model.outer_optimizer.reset()
        self.arm = Arm.of(model)
        mine.put_into(model)
        model.logger.record("growth/statistic", chosen.statistic)

    def _compare(self, model: Any, learning: Learning) -> None:
        """Compare the two programs, and keep the one that is worth its length, or let the trial go on."""
        task, _ = model._begin_task(COMPARE, n_tasks=model.n_envs)
        without = episode_returns(model, task, learning)
        with self._other_arm(model):
            with_it = episode_returns(model, task, learning)
        if learning.stopped:
            return  # as if the last step had not been: the trial is open, and is compared when training goes on
        assert self.arm is not None
        outcome = Comparison.of(without, with_it, model.length_coef)
        self.waited, self.rounds = 0, self.rounds + 1
        if outcome.undecided and self.rounds < MAX_ROUNDS:
            return
        if outcome.pays:
            self.arm.put_into(model)
        self.arm, self.refused = None, 0 if outcome.pays else self.refused + 1
        self._tell(model, outcome)

    def _tell(self, model: Any, outcome: Comparison) -> None:
        n_conditions = model.search.most_likely() + (not outcome.pays)
        told: dict[str, Any] = {"timesteps": model.num_timesteps, "n_conditions": n_conditions, **asdict(outcome)}
        told |= {"rounds": self.rounds, "kept": outcome.pays}
        self.trials.append(told)
        for name in ("return_before", "rise", "rise_std_error", "price"):
            model.logger.record(f"growth/{name}", told[name])
        kept = sum(trial["kept"] for trial in self.trials)
        for name, count in (("tried", len(self.trials)), ("kept", kept), ("taken_back", len(self.trials) - kept)):
            model.logger.record(f"growth/{name}", count)
        if model.verbose:
            print(
                f"Condition {n_conditions} {'kept' if outcome.pays else 'taken back'} at step {model.num_timesteps}: "
                f"return {outcome.return_before:.4g}, with it {outcome.rise:+.4g} (standard error "
                f"{outcome.rise_std_error:.2g}, price {outcome.price:.2g})"
            )


def look_around(model: Any, learning: Learning) -> Experience | None:
    """Collect as many rollouts as a task has, or more if they are short, without an update; return states of them.

    :param model: a ReptilePPO
    :param learning: what its ``learn`` keeps
    :return: ``None`` if a callback ended the training
    """
    task, rng = model._begin_task(LOOK)
    model.rng = rng
    if model.reward_scaler is not None:
        model.reward_scaler.reset_returns()
    start_task(model, model.tasks, task)
    model._task, model._statistics = task, EpisodeStatistics(model.tasks)
    parts = []
    for _ in range(max(model.inner_updates, -(-MIN_LOOK // (model.n_steps * model.n_envs)))):
        if not model.collect_rollouts(model.env, learning.callback, model.rollout_buffer, model.n_steps):
            learning.stopped = True
            return None
        model._statistics.flush(model.logger)
        parts.append(_experience(model))
    model._update_current_progress_remaining(model.num_timesteps, model._total_timesteps)
    columns = [th.cat([getattr(part, name) for part in parts]) for name in Experience.__dataclass_fields__]
    chosen = np.sort(rng.permutation(len(columns[0]))[:MAX_STATES])
    return Experience(*(column[th.from_numpy(chosen).to(column.device)] for column in columns))


@th.no_grad()
def _experience(model: Any) -> Experience:
    """Return what the rollout buffer holds."""
    buffer = model.rollout_buffer
    rollout = buffer.sequences(model.sequence_length)
    observations = rollout["observations"].flatten(0, 1)
    if buffer.condition_values is None:
        states = states_of(rollout).pi if model.recurrent else None
        values = model.policy.condition_values(observations, states)
    else:
        values = buffer.lay_out(buffer.condition_values, model.sequence_length).flatten(0, 1)
    return Experience(observations, values, rollout["actions"].flatten(0, 1), rollout["advantages"].flatten())
