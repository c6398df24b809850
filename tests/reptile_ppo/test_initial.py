"""ReptilePPO from a program: what it starts from is the program, and learning goes on from there."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_progpolicy import ReptilePPO, load_pretrained
from sb3_progpolicy.differentiable.initial import put_program
from sb3_progpolicy.differentiable.module import ProgramModule
from sb3_progpolicy.interaction import program_names
from sb3_progpolicy.programs import Condition, Controller, IfThenElse, Program, ProgramRunner
from sb3_progpolicy.reptile_ppo.initial import ACTION_STD, TEMPERATURE
from sb3_progpolicy.spaces import action_spec
from sb3_progpolicy.vec_env import make_fast_vec_env
from tests.programs.strategies import condition as random_condition
from tests.reptile_ppo.models import make, weights

BALANCE = "if angle + speed of the angle >= 0 then right else left"


def cartpole(n_conditions=1, **fields):
    """Pushes to the side to which the pole falls; the conditions after the first are never asked."""
    left, right = (Controller(((0.0,) * 4, (0.0,) * 4), bias) for bias in ((2.0, -2.0), (-2.0, 2.0)))
    falls_right = Condition("affine", (), (), (), (), (0.0, 0.0, 1.0, 0.5), 0.0)
    body = left
    for _ in range(n_conditions - 1):
        body = IfThenElse(falls_right, right, body)
    body = IfThenElse(falls_right, right, body)
    env = make_fast_vec_env("CartPole-v1", 1)
    names = program_names(env)
    origin = {"metadata": {"env": "CartPole-v1", "learned_by": "imitation"}, **fields}
    return Program(body, 4, action_spec(env.action_space), False, *names, **origin)


def recurrent(cell, size, env="Pendulum-v1", n_conditions=2):
    rng = np.random.default_rng(3)
    venv = make_fast_vec_env(env, 1)
    inputs, outputs = program_names(venv)
    body = Controller(((0.5, -0.25, 1.0),), (0.125,))
    for k in range(n_conditions):
        body = IfThenElse(random_condition(rng, cell, len(inputs), size), Controller(((1.0, k, 0.0),), (0.0,)), body)
    return Program(body, len(inputs), action_spec(venv.action_space), False, inputs, outputs)


def rounded(program):
    """The numbers of a program in single precision."""
    to_single = np.vectorize(lambda number: float(np.float32(number)), otypes=[float])

    def of(node):
        if isinstance(node, (Condition, Controller)):
            return type(node)(**{name: of(value) for name, value in vars(node).items()})
        if isinstance(node, IfThenElse):
            return IfThenElse(of(node.condition), of(node.then), of(node.orelse))
        if isinstance(node, str) or node == ():
            return node
        if isinstance(node, tuple):
            numbers = to_single(np.array(node)).tolist()
            return tuple(tuple(row) if isinstance(row, list) else row for row in numbers)
        return float(to_single(node))

    return of(program.body)


def episode(program, env_id, n_envs=4, n_steps=150, **options):
    """The observations that a crisp program meets, ``(n_steps, n_envs, n_observations)``, and its actions."""
    env = make_fast_vec_env(env_id, n_envs, 0, **options)
    runner, observation, met, actions = ProgramRunner(program, n_envs, "crisp"), env.reset(), [], []
    for _ in range(n_steps):
        action = runner.act(observation)
        met.append(observation)
        actions.append(action)
        observation, *_ = env.step(action)
    env.close()
    return np.array(met), np.array(actions)


@pytest.mark.parametrize(
    ("policy", "env", "program"),
    [
        ("PRLPolicy", "CartPole-v1", cartpole(3)),
        ("ProgPolicy", "CartPole-v1", cartpole()),
        ("ProgPolicy", "PandaPush-v0", "PandaPush-v0"),
        ("ProgPolicy", "Stacking-v0", "Stacking-v0"),
        ("ProgPolicy", "Pendulum-v1", recurrent("gru", 1)),
        ("ProgPolicy", "Pendulum-v1", recurrent("gru", 3)),
        ("ProgPolicy", "Pendulum-v1", recurrent("lstm", 2)),
        ("ProgPolicy", "Pendulum-v1", recurrent("rnn", 1)),
        ("PRLPolicy", "Pendulum-v1", recurrent("min", 2)),
        ("ProgPolicy", "Pendulum-v1", recurrent("min", 3)),
    ],
)
def test_program_of_the_model_is_the_one_given_in_single_precision(policy, env, program):
    given = load_pretrained(program) if isinstance(program, str) else program
    model = make(policy, env, n_envs=1, interaction_history=given.interaction, init_program=program)
    assert model.program().body == rounded(given)
    assert not model.search.searching
    assert model.policy.module.depth == len(given.conditions) + 1


def test_inputs_that_the_program_does_not_read_get_no_weight():
    given = cartpole()
    model = make(env="CartPole-v1", init_program=given, policy_kwargs={"depth": 4})
    program = model.program()
    assert program.interaction
    assert program.conditions[0].readout == (0.0, 0.0, 1.0, 0.5, *[0.0] * 4)
    assert len(program.conditions) == 1, "a graph of more layers is the program, too"
    shallow = make(env="CartPole-v1", init_program=given, policy_kwargs={"depth": 1}).program()
    assert len(shallow.conditions) == 1, "a depth that is too small for it, as of a file, is made to fit"
    assert all(row[4:] == (0.0,) * 4 for controller in program.controllers for row in controller.weights)


def test_crisp_and_soft_program_are_equal_on_the_states_it_meets():
    """But for states closer to a boundary than 20 temperatures; the tolerance is what the sigmoid leaves there."""
    program = load_pretrained("PandaPush-v0")
    model = make("PRLPolicy", "PandaPush-v0", n_envs=1, interaction_history=False, init_program="PandaPush-v0")
    met, actions = (array.reshape(-1, array.shape[-1]) for array in episode(program, "PandaPush-v0", 2, 100))
    soft, _ = model.predict(met, deterministic=True)
    conditions = np.array([[*condition.readout, condition.readout_bias] for condition in program.conditions])
    values = np.c_[met, np.ones(len(met))] @ conditions.T
    decided = (np.abs(values) > 20 * TEMPERATURE).all(axis=1)
    assert decided.mean() > 0.95
    np.testing.assert_allclose(soft[decided], actions[decided], atol=1e-4)


@pytest.mark.parametrize("policy", ["PRLPolicy", "ProgPolicy"])
def test_actions_are_the_programs_from_the_first(policy):
    program = cartpole()
    model = make(policy, "CartPole-v1", interaction_history=False, init_program=program)
    met, actions = episode(program, "CartPole-v1")
    soft, _ = model.predict(met.reshape(-1, 4), deterministic=True)
    np.testing.assert_array_equal(soft, actions.ravel())


def test_recurrent_program_acts_alike_over_an_episode():
    program = recurrent("gru", 1)
    model = make(env="Pendulum-v1", n_envs=1, interaction_history=False, init_program=program)
    met, actions = episode(program, "Pendulum-v1", n_envs=1)
    state, soft = None, []
    for observation in met:
        action, state = model.predict(observation, state, deterministic=True)
        soft.append(action)
    assert len(np.unique(np.sign(actions))) > 1
    np.testing.assert_allclose(np.array(soft), actions, atol=1e-3)


def test_learning_goes_on_from_the_return_of_the_program():
    arguments = {"n_steps": 64, "batch_size": 256, "inner_updates": 1, "n_envs": 8, "interaction_history": False}
    arguments |= {"learning_rate": 1e-3, "meta_learning_rate": 1.0}
    returns = {}
    for start, chosen in ((BALANCE, {"init_program": cartpole()}), ("nothing", {"search_fraction": 0.0})):
        model = make("PRLPolicy", "CartPole-v1", **arguments, **chosen)
        before = weights(model)
        model.learn(8 * 64 * 4)
        assert (weights(model) != before).any()
        returns[start] = evaluate_policy(model, make_fast_vec_env("CartPole-v1", 8), 16, warn=False)[0]
    assert returns[BALANCE] > 450
    assert returns["nothing"] < 200


def test_parameters_of_the_program_are_trained():
    model = make("PRLPolicy", "CartPole-v1", interaction_history=False, init_program=cartpole(), temperature=0.1)
    before = model.program()
    model.learn(256)
    after = model.program()
    assert after.controllers != before.controllers
    assert after.conditions != before.conditions
    assert len(after.conditions) == len(before.conditions)


@pytest.mark.parametrize(
    ("named", "says"),
    [("imitation", "imitation+reinforcement"), ("imitation+reinforcement",) * 2, ("reinforcement",) * 2],
)
def test_program_says_how_it_was_learned_and_saving_keeps_it(named, says, tmp_path):
    program = dataclasses.replace(cartpole(), metadata={"learned_by": named})
    path = tmp_path / "program.json"
    program.save(path)
    model = make("PRLPolicy", "CartPole-v1", interaction_history=False, init_program=str(path)).learn(64)
    assert model.program().metadata["learned_by"] == says
    model.save(tmp_path / "model")
    path.unlink()
    loaded = ReptilePPO.load(tmp_path / "model", "CartPole-v1", device="cpu")
    assert loaded.program() == model.program()
    assert loaded.program().learned_by == says
    for going_on in (model, loaded):
        going_on.learn(64, reset_num_timesteps=False)
    assert loaded.program() == model.program()


def test_noise_and_temperature_are_small_unless_given():
    program = recurrent("rnn", 1)
    model = make(env="Pendulum-v1", interaction_history=False, init_program=program)
    assert model.policy.log_std.exp().item() == pytest.approx(2 * ACTION_STD)
    assert float(model.policy.module.temperature) <= TEMPERATURE * 10
    kwargs = {"temperature": 0.5, "log_std_init": -1.0}
    model = make(env="Pendulum-v1", interaction_history=False, init_program=program, policy_kwargs=kwargs)
    assert model.policy.log_std.item() == -1.0
    assert float(model.policy.module.temperature) == 0.5


def nested():
    inner = cartpole().body
    return dataclasses.replace(cartpole(), body=IfThenElse(inner.condition, inner, inner.orelse))


def of_two_kinds():
    body = IfThenElse(random_condition(np.random.default_rng(0), "gru", 4, 1), cartpole().body.then, cartpole().body)
    return dataclasses.replace(cartpole(), body=body)


OTHER_CELL = {"init_program": cartpole(), "policy_kwargs": {"cell": "gru"}}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"init_program": nested()}, "inside a then-branch"),
        ({"init_program": of_two_kinds()}, "conditions of different kinds"),
        ({"init_program": recurrent("gru", 1), "policy": "ProgPolicy"}, r"acts in box \(1,\).*discrete \(2,\)"),
        (
            {"init_program": cartpole(), "policy_kwargs": {"cell": "gru"}, "policy": "ProgPolicy"},
            "'affine' and size 1 does not fit",
        ),
        ({"init_program": cartpole(), "normalize_observations": True}, "normalize_observations"),
        ({"init_program": cartpole(), "policy": "MlpPolicy"}, "ProgPolicy and PRLPolicy are programs"),
        ({"init_program": "CartPole-v7"}, "CartPole-v7"),
        ({"init_program": "missing.json"}, "there is no such file"),
        ({"init_program": 3}, "init_program=int"),
        ({"init_program": "Hanoi-v0"}, "acts in discrete"),
        ({"init_program": "Hanoi-v0", "env": "Hanoi-v0", "interaction_history": False}, "interaction_history=True"),
        ({"init_program": "Hanoi-v0", "env_kwargs": {"context": "observed"}, "env": "Hanoi-v0"}, "of 9 numbers"),
    ],
)
def test_program_that_does_not_fit_is_refused(arguments, message):
    arguments = {"policy": "PRLPolicy", "env": "CartPole-v1", **arguments}
    if arguments["env"] == "CartPole-v1":
        arguments.setdefault("interaction_history", False)
    with pytest.raises(ValueError, match=message):
        make(**arguments)


@pytest.mark.parametrize(
    ("n_inputs", "depth", "cell", "message"),
    [(4, 1, "affine", "depth=2 is needed"), (3, 2, "affine", "has 3 inputs"), (4, 2, "gru", "'affine' and size 1")],
)
def test_module_that_cannot_be_the_program_is_left_alone(n_inputs, depth, cell, message):
    module = ProgramModule(n_inputs, cartpole().action, depth, cell)
    before = {name: tensor.clone() for name, tensor in module.state_dict().items()}
    with pytest.raises(ValueError, match=message):
        put_program(module, cartpole())
    assert all((tensor == before[name]).all() for name, tensor in module.state_dict().items())


def test_recurrent_program_needs_a_recurrent_policy():
    with pytest.raises(ValueError, match="RecurrentProgrammaticPolicy"):
        make("PRLPolicy", "Pendulum-v1", init_program=recurrent("gru", 1))


def test_observations_normalised_by_a_wrapper_are_refused():
    env = VecNormalize(DummyVecEnv([lambda: gym.make("CartPole-v1")] * 2))
    with pytest.raises(ValueError, match="VecNormalize"):
        make("PRLPolicy", env, interaction_history=False, init_program=cartpole())


def test_names_in_another_order_are_warned_of():
    program = cartpole()
    other = dataclasses.replace(program, input_names=program.input_names[::-1])
    with pytest.warns(UserWarning, match="taken in their order"):
        make("PRLPolicy", "CartPole-v1", interaction_history=False, init_program=other)


def test_program_whose_weights_need_not_be_tied_is_refused():
    tied = make(env="Hanoi-v0", symmetric=True).policy.module
    with pytest.raises(ValueError, match="tied over symmetries is not accepted"):
        put_program(tied, load_pretrained("Hanoi-v0"))
    with pytest.raises(ValueError, match="init_program is not accepted with symmetric=True"):
        make(env="Hanoi-v0", init_program="Hanoi-v0", symmetric=True)


def test_number_of_conditions_is_that_of_the_program():
    program = load_pretrained("PandaSlide-v0")
    kwargs = {"n_conditions": 5, "cell": "affine"}
    model = make(
        "PRLPolicy", "PandaSlide-v0", n_envs=1, interaction_history=False, init_program=program, policy_kwargs=kwargs
    )
    assert len(model.program().conditions) == len(program.conditions) != 5
