"""Which algorithm of Stable-Baselines3 or sb3-contrib has saved a file, read without unpickling anything."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import sb3_contrib
import stable_baselines3
from stable_baselines3.common.base_class import BaseAlgorithm

#: Packages of the policies that one algorithm has to itself, and the algorithm.
_BY_PACKAGE: dict[str, type[BaseAlgorithm]] = {
    "stable_baselines3.dqn": stable_baselines3.DQN,
    "stable_baselines3.sac": stable_baselines3.SAC,
    "stable_baselines3.td3": stable_baselines3.TD3,  # DDPG is one
    "sb3_contrib.ars": sb3_contrib.ARS,
    "sb3_contrib.common.maskable": sb3_contrib.MaskablePPO,
    "sb3_contrib.common.recurrent": sb3_contrib.RecurrentPPO,
    "sb3_contrib.crossq": sb3_contrib.CrossQ,
    "sb3_contrib.qrdqn": sb3_contrib.QRDQN,
    "sb3_contrib.tqc": sb3_contrib.TQC,
}
#: Attributes by which those with actor-critic policies differ, the most telling first.
_BY_ATTRIBUTE: dict[str, type[BaseAlgorithm]] = {
    "cg_max_steps": sb3_contrib.TRPO,
    "clip_range": stable_baselines3.PPO,
    "gae_lambda": stable_baselines3.A2C,
}
_MOST_BYTES = 2**26


def stock_algorithm(path: Path) -> type[BaseAlgorithm] | None:
    """Return the algorithm that has saved a file.

    :param path: a ``.zip`` file
    :return: ``None`` if it is not a file in the form of Stable-Baselines3
    :raises ValueError: if it is one, of an algorithm that is not known here
    """
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            if "data" not in names or "policy.pth" not in names:
                return None
            with archive.open("data") as file:
                document = json.loads(file.read(_MOST_BYTES))
        policy = document["policy_class"]
        module = str(policy["__module__"])
    except (OSError, zipfile.BadZipFile, ValueError, LookupError, TypeError, AttributeError, RuntimeError):
        return None
    for package, algorithm in _BY_PACKAGE.items():
        if module.startswith(f"{package}."):
            return algorithm
    if "lstm_actor" in policy:
        return sb3_contrib.RecurrentPPO
    for attribute, algorithm in _BY_ATTRIBUTE.items():
        if attribute in document:
            return algorithm
    raise ValueError(
        f"{path} was saved by an algorithm that is not known, with a policy of {module}. Load it in Python; "
        "evaluate_model and imitate take the model itself"
    )
