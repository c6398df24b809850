"""What fails on purpose, by what the failure says. ``docs/guide/sb3_differences.md`` says why."""

import re
from collections.abc import Mapping, Sequence

LSTM_ARGUMENTS = "lstm_hidden_size|n_lstm_layers|shared_lstm|enable_critic_lstm|lstm_kwargs"

#: Patterns of ``test: message``, by the name of the difference.
DIFFERENCES: Mapping[str, Sequence[str]] = {
    "observation space": [r"observation space .* is not accepted"],
    "history": [r"the observation has \d+ numbers; the policy reads"],
    "use_sde": [r"use_sde=True is not accepted", r"unexpected keyword argument '(use_sde|sde_sample_freq)'"],
    "features extractor": [r"features_extractor_class=\w+ is not accepted"],
    "actor's net_arch": [r"net_arch=.* is not accepted; the actor is a program"],
    "LSTM arguments": [rf"unexpected keyword argument '({LSTM_ARGUMENTS})'"],
    "file format": [r"is not data", r"test_load_bad_zip.*Regex pattern did not match"],
    "learning speed": [r"test_continuous\b.*Mean reward below threshold"],
    "names": [
        r"test_tensorboard\[ppo\].*assert False",  # looks for the folder PPO_1
        r"test_ppo_warnings.*(run Reptile\w+ on the GPU|DID NOT WARN)",  # looks for PPO and MlpPolicy
    ],
    "state dict": [r"test_save_load(_policy)?\b.*not implemented for 'Long'"],  # draws a random W.selected
}


def reason(test: str, message: str) -> str | None:
    """Return the difference that makes a test fail, or ``None`` if no difference does.

    :param test: its name
    :param message: of the failure
    """
    said = f"{test}: {message}"
    for name, patterns in DIFFERENCES.items():
        if any(re.search(pattern, said, re.DOTALL) for pattern in patterns):
            return name
    return None
