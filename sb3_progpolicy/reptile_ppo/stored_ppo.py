"""SequencePPO whose models are saved as data and loaded from data alone."""

from __future__ import annotations

import io
import pathlib
from collections.abc import Iterable
from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.type_aliases import GymEnv, TensorDict

from sb3_progpolicy.reptile_ppo.loading import load_model, parameters_of
from sb3_progpolicy.reptile_ppo.saving import print_versions, write_model
from sb3_progpolicy.reptile_ppo.sequence_ppo import SequencePPO

SelfStoredPPO = TypeVar("SelfStoredPPO", bound="StoredPPO")


class StoredPPO(SequencePPO):
    """SequencePPO with files of its own in place of SB3's, which are pickles."""

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
        *,
        allow_pickle: bool = False,
    ) -> None:
        """Save the model as data: a zip of JSON and safetensors. A file is replaced only when the new one is complete.

        :param path: of the file, or a stream
        :param exclude: fields to leave out: names of constructor arguments
        :param include: fields not to leave out, though they are in ``exclude``
        :param allow_pickle: pickle what is not data, such as a function; :meth:`load` then asks for the same
        :raises ValueError: if something is not data, or a parameter is not finite
        """
        write_model(self, path, exclude, include, allow_pickle)

    @classmethod
    def load(
        cls: type[SelfStoredPPO],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | str | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        *,
        allow_pickle: bool = False,
        **kwargs: Any,
    ) -> SelfStoredPPO:
        """Load a model, from data alone. See SB3's ``BaseAlgorithm.load`` for what is not said here.

        :param path: of the file, or a stream
        :param env: an environment id is accepted too; ``n_envs`` and ``env_kwargs`` are the saved ones unless given
        :param custom_objects: fields to take instead of the file's
        :param allow_pickle: load a file that you trust although it holds pickles, which runs the code in them: one
            saved with ``allow_pickle=True``, or by release 0.1
        :param kwargs: arguments of the constructor to change
        :raises ValueError: if the file is damaged, holds pickles, or something cannot be changed
        """
        if print_system_info:
            print_versions(path)
        return load_model(cls, path, env, device, custom_objects or {}, force_reset, allow_pickle, kwargs)

    def set_parameters(
        self, load_path_or_dict: str | TensorDict, exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """Load parameters. See SB3's ``BaseAlgorithm.set_parameters``."""
        super().set_parameters(parameters_of(self, load_path_or_dict), exact_match, device)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer", "outer_optimizer"], []
