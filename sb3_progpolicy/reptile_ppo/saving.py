"""Models as files: a zip of JSON and safetensors, from which nothing is unpickled.

``model.json`` holds the constructor's :data:`ARGUMENTS`, the :data:`STATE` of the training and the optimizers'
settings; ``tensors.safetensors`` parameters and moments. What is not data goes into ``<field>.pkl``, if at all.
"""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import safetensors
import safetensors.numpy
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.utils import get_system_info

from sb3_progpolicy.programs.files import write_atomically
from sb3_progpolicy.reptile.samplers import SAMPLERS
from sb3_progpolicy.reptile.tasks import TaskDistribution
from sb3_progpolicy.reptile_ppo.fields import ARGUMENTS, STATE
from sb3_progpolicy.reptile_ppo.values import ModelFormatError, NotDataError, from_data, to_data

FORMAT, VERSION = "sb3-progpolicy model", 1
DOCUMENT, TENSORS = "model.json", "tensors.safetensors"
MAX_BYTES = {DOCUMENT: 2**24, TENSORS: 2**31}
MAX_CONTAINERS = 10**5

Tensors = dict[str, NDArray[Any]]


OPTIMIZERS = ("policy.optimizer", "outer_optimizer")
#: Before the names of what belongs to the program that growth is trying.
ARM = "growth/"
ROLLOUT = ("_last_obs", "_last_episode_starts")


@dataclass
class SavedModel:
    """What a file holds.

    :param arguments: of the constructor
    :param state: of the training
    :param optimizers: their settings, by optimizer
    :param tensors: by the names of what they belong to, a slash, and their own
    """

    arguments: dict[str, Any]
    state: dict[str, Any]
    optimizers: dict[str, Any]
    tensors: Tensors

    def under(self, prefix: str) -> Tensors:
        """Return the tensors of one object, by their own names."""
        return {name[len(prefix) + 1 :]: value for name, value in self.tensors.items() if name.startswith(prefix + "/")}


# -------------------------------------------------------------------------------------------------------- write


def write_model(
    model: Any,
    path: str | os.PathLike[str] | io.BufferedIOBase,
    exclude: Iterable[str] | None,
    include: Iterable[str] | None,
    allow_pickle: bool,
) -> None:
    """Write a model; a file of the same name is replaced only when the new one is complete.

    :param model: a ReptilePPO
    :param path: of the file, or a stream of bytes
    :param exclude: fields to leave out
    :param include: fields not to leave out, though they are in ``exclude``
    :param allow_pickle: pickle what is not data
    :raises ValueError: if something is not data, or a number is not finite
    """
    left_out = set(exclude or ()) - set(include or ())
    document: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "saved_with": get_system_info(print_info=False)[0],
    }
    entries: dict[str, bytes] = {}
    refused = []
    for part, values, checks in (("arguments", _arguments(model), ARGUMENTS), ("state", _state(model), STATE)):
        document[part] = {}
        for name, value in values.items():
            if name in left_out:
                continue
            try:
                document[part][name] = to_data(value)
                if not checks[name](from_data(document[part][name])):
                    raise ValueError(f"the model is not saved: {name}={value!r:.60} would not be accepted on loading")
            except NotDataError as error:
                refused.append(f"{name}: {error}")
                if allow_pickle:
                    entries[f"{name}.pkl"] = cloudpickle.dumps(value)
    if refused and not allow_pickle:
        raise NotDataError(
            f"the model is not saved, as not all of it is data: {'; '.join(refused)}. Give numbers, text, lists or "
            "SB3's schedules instead, or pickle it with save(..., allow_pickle=True)"
        )
    parameters = model.get_parameters()
    if model.growth is not None:
        parameters |= {ARM + name: values for name, values in model.growth.parameters().items()}
    document["optimizers"] = {
        name: to_data(values.get("param_groups", []))
        for name, values in parameters.items()
        if name.removeprefix(ARM) in OPTIMIZERS
    }
    entries[TENSORS] = safetensors.numpy.save(_tensors(model, parameters))
    content = _zip({DOCUMENT: json.dumps(document, allow_nan=False).encode(), **entries})
    if isinstance(path, (str, os.PathLike)):
        path = _with_suffix(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, content)
    else:
        path.write(content)


def _arguments(model: Any) -> dict[str, Any]:
    """The constructor's arguments, read off a model; those that are no attributes of the same name come first."""
    aliases = {policy: alias for alias, policy in model.policy_aliases.items()}
    read: dict[str, Any] = {
        "policy": aliases.get(model.policy_class, model.policy_class),
        "tasks": _tasks_to_plain(model.tasks),
        "scale_rewards": model.reward_scaler is not None,
        "stats_window_size": model._stats_window_size,
    }
    return {name: read[name] if name in read else getattr(model, name) for name in ARGUMENTS}


def _tasks_to_plain(tasks: TaskDistribution) -> Any:
    samplers = {sampler: name for name, sampler in SAMPLERS.items()}
    if type(tasks) is not TaskDistribution or type(tasks.sampler) not in samplers:
        return tasks
    return {
        "variations": tasks.variations,
        "sampler": samplers[type(tasks.sampler)],
        "sampler_arguments": dict(vars(tasks.sampler)),
        "check": tasks.check,
        "apply": tasks.apply,
        "success_rates": _with_none(tasks.success_rates),
        "scores": [_with_none(means) for means in tasks.scores],
    }


def _with_none(means: NDArray[np.float64]) -> list[float | None]:
    return [None if np.isnan(mean) else float(mean) for mean in means]


def _state(model: Any) -> dict[str, Any]:
    episodes, successes = model.ep_info_buffer, model.ep_success_buffer
    return {
        "env_id": model.env_id,
        "n_envs": model.n_envs,
        "observation_space": model.observation_space,
        "action_space": model.action_space,
        "input_names": model.input_names,
        "output_names": model.output_names,
        "wrappers": _wrappers(model),
        "learned_by": model.learned_by,
        "num_timesteps": model.num_timesteps,
        "total_timesteps": model._total_timesteps,
        "progress_remaining": model._current_progress_remaining,
        "n_updates": model._n_updates,
        "meta_iteration": model.meta_iteration,
        "rng": model.rng.bit_generator.state,
        "reward_statistics": model.reward_scaler and model.reward_scaler.state(),
        "growth": None if model.growth is None else model.growth.state(),
        "episodes": None if episodes is None else [[episode[key] for key in "rlt"] for episode in episodes],
        "successes": None if successes is None else list(successes),
    }


def _wrappers(model: Any) -> tuple[str, ...]:
    """The wrappers that an id does not bring back, with VecNormalize, whose statistics are not in the file."""
    normalized = () if model.get_vec_normalize_env() is None else ("VecNormalize",)
    return tuple(dict.fromkeys((*model.wrappers, *normalized)))


def _tensors(model: Any, parameters: Mapping[str, Any]) -> Tensors:
    tensors: dict[str, th.Tensor] = {}
    for owner, held in parameters.items():
        if owner.removeprefix(ARM) == "policy":
            tensors |= {f"{owner}/{name}": tensor for name, tensor in held.items()}
            continue
        for index, values in held.get("state", {}).items():
            tensors |= {f"{owner}/{index}/{name}": th.as_tensor(value) for name, value in values.items()}
    arrays = {name: np.ascontiguousarray(tensor.detach().cpu().numpy()) for name, tensor in tensors.items()}
    arrays = {name: array.reshape(tensors[name].shape) for name, array in arrays.items()}
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(f"the model is not saved: {name} holds numbers that are not finite")
    if isinstance(model._last_obs, np.ndarray):
        arrays |= {f"rollout/{name}": np.ascontiguousarray(getattr(model, name)) for name in ROLLOUT}
    return arrays


def _zip(entries: Mapping[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, content in entries.items():
            archive.writestr(zipfile.ZipInfo(name), content)  # without the time: equal models are equal files
    return buffer.getvalue()


def _with_suffix(path: str | os.PathLike[str]) -> Path:
    path = Path(path)
    return path if path.suffix else path.with_suffix(".zip")


# -------------------------------------------------------------------------------------------------------- read


def is_sb3_file(path: str | os.PathLike[str] | io.BufferedIOBase) -> bool:
    """Return whether a file is SB3's zip, which holds pickles, as release 0.1 wrote it."""
    return "data" in _read_zip(path, only=())


def print_versions(path: str | os.PathLike[str] | io.BufferedIOBase) -> None:
    """Print the versions of libraries here, and those that a file was saved with, as SB3 does."""
    print("== CURRENT SYSTEM INFO ==")
    get_system_info()
    entries = _read_zip(path, only=(DOCUMENT,))
    if DOCUMENT in entries:
        print("== SAVED MODEL SYSTEM INFO ==")
        for name, text in _parse(entries[DOCUMENT])["saved_with"].items():
            print(f"- {ascii(name)[1:-1]:.40}: {ascii(text)[1:-1]:.100}")  # a file may hold control characters


def read_model(
    path: str | os.PathLike[str] | io.BufferedIOBase, allow_pickle: bool = False, replaced: Collection[str] = ()
) -> SavedModel:
    """Read and check a file.

    :param path: of the file, or a stream of bytes
    :param allow_pickle: unpickle what is not data, which runs code that the file gives
    :param replaced: fields that are not needed
    :raises ModelFormatError: if the file is damaged or holds what is not accepted
    :raises ValueError: if the file holds pickles and ``allow_pickle`` is not given
    """
    entries = _read_zip(path, only=None if allow_pickle else (DOCUMENT, TENSORS))
    pickled = {name.removesuffix(".pkl") for name in entries if name.endswith(".pkl")} - set(replaced)
    if pickled and not allow_pickle:
        raise ValueError(
            f"{path} holds pickles ({', '.join(sorted(pickled))}), and loading one runs the code in it. If you trust "
            "where it comes from, load it with allow_pickle=True"
        )
    document = _parse(entries[DOCUMENT])
    parts = []
    for part, checks in (("arguments", ARGUMENTS), ("state", STATE)):
        values = document[part]
        for name, value in values.items():
            if name not in checks or not checks[name](value):
                raise ModelFormatError(f"{part}: {name!r:.40}={value!r:.60} is not accepted")
        parts.append({**values, **{name: cloudpickle.loads(entries[f"{name}.pkl"]) for name in pickled & set(checks)}})
    try:
        tensors = safetensors.numpy.load(entries[TENSORS])
    except (safetensors.SafetensorError, KeyError, ValueError, TypeError) as error:
        raise ModelFormatError(f"{TENSORS} is damaged: {error}") from None
    return SavedModel(parts[0], parts[1], document["optimizers"], tensors)


def _read_zip(path: str | os.PathLike[str] | io.BufferedIOBase, only: Collection[str] | None) -> dict[str, bytes]:
    """Return the entries by name, empty but for those in ``only``; ``None`` reads all."""
    if isinstance(path, (str, os.PathLike)):
        path = path if Path(path).exists() else _with_suffix(path)
    try:
        with zipfile.ZipFile(path) as archive:
            infos = archive.infolist()
            names = [info.filename for info in infos]
            fields = {f"{name}.pkl" for name in (*ARGUMENTS, *STATE)}
            if "data" in names:
                return dict.fromkeys(names, b"")
            if len(set(names)) < len(names) or not {DOCUMENT, TENSORS} <= set(names) <= {DOCUMENT, TENSORS, *fields}:
                raise ModelFormatError(f"the file holds {names[:6]!r:.200}; {DOCUMENT} and {TENSORS} are expected")
            for info in infos:
                if info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size:
                    raise ModelFormatError(f"{info.filename} is compressed, which is not accepted")
                if info.file_size > (most := MAX_BYTES.get(info.filename, MAX_BYTES[TENSORS])):
                    raise ModelFormatError(f"{info.filename} has {info.file_size} bytes; at most {most} are accepted")
            return {name: archive.read(name) if only is None or name in only else b"" for name in names}
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError, OverflowError) as error:
        raise ModelFormatError(f"not a model, or damaged: {error or type(error).__name__}") from None


def _parse(raw: bytes) -> dict[str, Any]:
    if raw.count(b"[") + raw.count(b"{") > MAX_CONTAINERS:
        raise ModelFormatError(f"{DOCUMENT} holds more than {MAX_CONTAINERS} lists and objects")
    try:
        document = from_data(json.loads(raw, object_pairs_hook=_without_repetition))
    except RecursionError:
        raise ModelFormatError(f"{DOCUMENT} is nested too deeply") from None
    except ModelFormatError:
        raise
    except ValueError as error:
        raise ModelFormatError(f"{DOCUMENT} is damaged: {error}") from None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise ModelFormatError(f'{DOCUMENT} does not say "format": "{FORMAT}"')
    if document.get("version") != VERSION:
        raise ModelFormatError(f"version {document.get('version')!r:.20} is not accepted; this release reads {VERSION}")
    if not all(isinstance(document.get(part), dict) for part in ("saved_with", "arguments", "state", "optimizers")):
        raise ModelFormatError(f"{DOCUMENT} lacks saved_with, arguments, state or optimizers")
    return document


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) != len(pairs):
        raise ValueError("an object that holds the same key twice")
    return result
