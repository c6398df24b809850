"""What other students make of the same teacher and the same number of labelled states: trees and a network.

    python benchmarks/imitation_yardsticks.py --env PandaSlide-v0 --branches 8 [--episodes 100] [--final]

The students are a decision tree with as many leaves as a program has branches, one of depth 8, and a network with two
layers of 64 units, all from scikit-learn, in twelve rounds of DAgger (without the weights of VIPER, Bastani et al.
2018, which need the teacher's values). Needs the extra ``sizes``.

Writes ``benchmarks/results/<name>.csv`` after each student, and a ``.json`` with command, commit and versions.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from imitation_seeds import EVALUATION_SEED, _row, wanted_variations
from study import write_results

from progpolicy_envs import find_domain
from sb3_progpolicy.imitation import make_teacher
from sb3_progpolicy.imitation.actions import ActionCodec
from sb3_progpolicy.imitation.augmentation import make_augmentation, make_starts
from sb3_progpolicy.imitation.decision_list import Scaler
from sb3_progpolicy.imitation.rollouts import Act, Pool, play
from sb3_progpolicy.imitation.rounds import N_ROUNDS, N_SPARSE_ROUNDS, TEACHER_SHARES
from sb3_progpolicy.imitation.tasks import names_of, training_variations
from sb3_progpolicy.imitation.visits import Collector
from sb3_progpolicy.spaces import action_spec

COLUMNS = (
    *("student", "learned_by", "set", "variation", "episodes", "success_rate", "steps_mean", "return_mean"),
    *("cpu_seconds",),
)
_N_ENVS = 24


def students(n_branches: int, seed: int) -> dict[str, Callable[[], Any]]:
    """Return what makes each student, by name."""
    from sklearn.neural_network import MLPRegressor
    from sklearn.tree import DecisionTreeRegressor

    return {
        f"tree of {n_branches} leaves": lambda: DecisionTreeRegressor(max_leaf_nodes=n_branches, random_state=seed),
        "tree of depth 8": lambda: DecisionTreeRegressor(max_depth=8, min_samples_leaf=5, random_state=seed),
        "network 64-64": lambda: MLPRegressor(
            hidden_layer_sizes=(64, 64), early_stopping=True, max_iter=100, random_state=seed
        ),
    }


def learn(
    make: Callable[[], Any], pool: Pool, env_id: str, n_timesteps: int, seed: int, augment: str | None = None
) -> Act:
    """Return the student after the rounds of DAgger that a program has, on all inputs but ``left``."""
    env: Any = pool.envs[0]
    spec = action_spec(env.action_space)
    inputs, outputs = names_of(env, spec.n_outputs, interaction=False)
    codec = ActionCodec(spec, outputs)
    readable = np.array([name != "left" for name in inputs])
    augmentation = make_augmentation(augment, inputs)
    collector = Collector(pool, make_teacher("planner", env), *training_variations(env_id, None), seed, augmentation)
    collector.begin()
    n_rounds = N_ROUNDS + N_SPARSE_ROUNDS
    n_steps = n_timesteps // ((n_rounds + 1) * len(pool))
    observations, targets = [], []
    act: Act | None = None
    for number in range(n_rounds):
        share = TEACHER_SHARES[number] if number < len(TEACHER_SHARES) else 0.0
        visits = collector.collect(n_steps * (1 if number else 2), act, share)
        observations.append(visits.inputs)
        targets.append(codec.encode(visits.actions))
        known = np.concatenate(observations)
        collector.stalls.deviations = known.std(axis=0)
        scaler = Scaler.of(known, readable)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a network that has not converged
            model = make().fit(scaler(known)[:, :-1], np.concatenate(targets))

        def act(seen: Any, model: Any = model, scaler: Scaler = scaler) -> Any:
            return codec.decode(model.predict(scaler(seen)[:, :-1]))

    assert act is not None
    return act


def main() -> None:
    """Run the comparison."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", required=True, help="environment id of a domain with a planner")
    parser.add_argument("--branches", type=int, default=9, help="leaves of the small tree")
    parser.add_argument("--n-timesteps", type=int, default=30_000, help="states to label")
    parser.add_argument("--episodes", type=int, default=100, help="episodes on each variation")
    parser.add_argument("--augment", help="more than the training variations: taller_towers or begun_towers")
    parser.add_argument("--seed", type=int, default=0, help="of all draws")
    parser.add_argument("--sizes", type=int, nargs="+", help="sizes to run on; by default all")
    parser.add_argument("--final", action="store_true", help="look at the unseen variations, too")
    options = parser.parse_args()
    assert find_domain(options.env) is not None, f"{options.env} has no planner"
    wanted = wanted_variations(options.env, options.final, options.sizes)
    learned = "imitation" + (f", {options.augment}" if options.augment else "")
    file = f"imitation_yardsticks_{options.env.rpartition('-')[0].lower()}"
    file += f"_{options.augment}" if options.augment else ""
    arguments = {"n_timesteps": options.n_timesteps, "augment": options.augment}
    rows = []
    pool, visited = Pool(options.env, _N_ENVS), Pool(options.env, _N_ENVS, begin=make_starts(options.augment))
    for name, make in students(options.branches, options.seed).items():
        started = time.process_time()
        act = learn(make, visited, options.env, options.n_timesteps, options.seed, options.augment)
        seconds = round(time.process_time() - started, 1)
        for kind, variation in wanted:
            played = play(pool, [variation], options.episodes, EVALUATION_SEED, act)
            about = {"student": name, "learned_by": learned, "set": kind, "cpu_seconds": seconds}
            rows.append({**about, **_row(variation, played)})
            print(rows[-1])
        write_results(file, COLUMNS, rows, arguments, ["scikit-learn"])
    pool.close()
    visited.close()


if __name__ == "__main__":
    main()
