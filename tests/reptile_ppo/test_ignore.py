"""``ReptilePPO(ignore=...)``: inputs that neither the policy nor its program reads."""

import numpy as np
import pytest

from sb3_progpolicy import ReptilePPO
from sb3_progpolicy.programs.interpreter import ProgramRunner

SMALL = {"n_envs": 2, "n_steps": 16, "batch_size": 32, "seed": 0, "interaction_history": False}


@pytest.mark.parametrize(("policy", "changes"), [
    ("ProgPolicy", {}),
    ("ProgPolicy", {"symmetric": True}),
    ("ProgPolicy", {"policy_kwargs": {"cell": "affine", "n_conditions": 2}}),
    ("MlpPolicy", {"normalize_observations": True}),
])  # fmt: skip
def test_an_ignored_input_changes_nothing(policy, changes, tmp_path):
    model = ReptilePPO(policy, "PandaPush-v0", ignore=["left"], **SMALL, **changes).learn(64)
    observations = np.random.default_rng(0).normal(size=(20, 32)).astype(np.float32)
    changed = observations.copy()
    changed[:, model.input_names.index("left")] += 7
    actions = model.predict(observations, deterministic=True)[0]
    np.testing.assert_array_equal(model.predict(changed, deterministic=True)[0], actions)
    if policy == "ProgPolicy":
        program = model.program()
        assert "left" not in str(program)
        acted = ProgramRunner(program, 20).act(observations)
        np.testing.assert_array_equal(ProgramRunner(program, 20).act(changed), acted)
    model.save(tmp_path / "model.zip")
    for env in (None, "PandaPush-v0"):
        loaded = ReptilePPO.load(tmp_path / "model.zip", env=env)
        assert loaded.ignore == ["left"]
        np.testing.assert_array_equal(loaded.predict(changed, deterministic=True)[0], actions)
    loaded.learn(32, reset_num_timesteps=False)


@pytest.mark.parametrize(("changes", "message"), [
    ({"ignore": ["lef"]}, "there is no input lef; the inputs are gripper_x"),
    ({"ignore": "left"}, "ignore='left' is not accepted; it is a sequence of names"),
    ({"ignore": ["left"], "normalize_observations": False}, "not accepted with normalize_observations=False"),
    ({"ignore": ["object_y"], "symmetric": True}, None),
])  # fmt: skip
def test_what_cannot_be_ignored_is_said(changes, message):
    if message is None:  # it is its own image
        ReptilePPO("ProgPolicy", "PandaPush-v0", **{**SMALL, **changes})
        return
    with pytest.raises(ValueError, match=message):
        ReptilePPO("ProgPolicy", "PandaPush-v0", **{**SMALL, **changes})


def test_images_of_ignored_inputs_are_ignored_too():
    arguments = {**SMALL, "symmetric": True, "normalize_observations": True}
    with pytest.raises(ValueError, match="have images under the symmetries"):
        ReptilePPO("ProgPolicy", "Stacking-v0", ignore=["table[0,0]"], **arguments)
    corners = [f"table[{row},{column}]" for row in (0, 4) for column in (0, 4)]
    ReptilePPO("ProgPolicy", "Stacking-v0", ignore=corners, **arguments)
