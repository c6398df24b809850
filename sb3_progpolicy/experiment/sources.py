"""What a name on the command line stands for: a run folder, a program, a model, or a program that is shipped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_progpolicy.env_ids import env_to_act_in, id_from_file, same_env
from sb3_progpolicy.nearest import unknown
from sb3_progpolicy.pretrained import load_pretrained, pretrained_names
from sb3_progpolicy.programs.interpreter import Semantics
from sb3_progpolicy.programs.program import Program, load_program
from sb3_progpolicy.surroundings import own_env_kwargs

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

    from sb3_progpolicy.evaluation import Evaluation


@dataclass(frozen=True)
class Source:
    """What a name on the command line stands for.

    :param name: as given
    :param env_id: environment it was trained in, if known and no module has to be imported for it
    :param program: if it is one
    :param model: if it is not a program
    :param env_kwargs: constructor arguments that it was trained with
    :param named_env: environment that it names, whichever module registers it
    """

    name: str
    env_id: str | None
    program: Program | None
    model: BaseAlgorithm | None
    env_kwargs: dict[str, Any]
    named_env: str | None = None

    def within(self, env: str | None = None) -> Source:
        """Return it with the environment that it is to act in, and the constructor arguments that are for this one.

        :param env: in place of the environment that it was trained in; its module is imported where it is needed
        :raises ValueError: if no environment is known
        """
        named = self.named_env or self.env_id
        env_id = env_to_act_in(env or self.env_id, named, self.name, "--env ")
        return replace(self, env_id=env_id, env_kwargs=self.env_kwargs if same_env(env_id, named) else {})


def find_program(name: str, env: str | None = None, allow_pickle: bool = False) -> tuple[Program, str]:
    """Load a program and say which environment it is for.

    :param name: see :func:`find_source`
    :param env: an environment in place of the one that it was trained in
    :param allow_pickle: see :func:`find_source`
    :raises ValueError: if it is not a program, or does not say which environment it is for
    """
    source = find_source(name, allow_pickle)
    if source.program is None:
        raise ValueError(f"{name} is not a program; ProgPolicy and PRLPolicy learn programs")
    program, env_id = source.program, source.within(env).env_id
    assert env_id is not None
    if source.env_kwargs:
        program = replace(program, metadata={**program.metadata, "env_kwargs": source.env_kwargs})
    return program, env_id


def find_source(name: str, allow_pickle: bool = False) -> Source:
    """Load a run folder, a program's ``.json``, a model's ``.zip`` or a pretrained program, in this order.

    :param name: a path or a name
    :param allow_pickle: see :func:`~sb3_progpolicy.experiment.folder.load_model`
    :raises ValueError: if there is nothing of that name; the message names the nearest pretrained programs
    """
    path = Path(name)
    if path.is_dir():
        return _from_run(path, allow_pickle)
    if path.is_file() and path.suffix == ".json":
        source = _from_program(name, load_program(path))
        return replace(source, env_id=id_from_file(source.env_id))
    if path.is_file() and path.suffix == ".zip":
        return _from_model(path, allow_pickle)
    if path.suffix in (".json", ".zip") or path.is_file():
        reason = "is neither a .json nor a .zip file" if path.is_file() else "does not exist"
        raise ValueError(f"{name} {reason}; give a run folder, a program (.json), a model (.zip) or a pretrained name")
    if name.rpartition(":")[2] in pretrained_names():
        return _from_program(name, load_pretrained(name))
    raise unknown("run, file or pretrained program", name, pretrained_names())


def evaluate_source(
    source: Source,
    variations: Sequence[Mapping[str, Any]],
    n_episodes: int,
    semantics: Sequence[Semantics] = ("crisp",),
    env_id: str | None = None,
    **arguments: Any,
) -> list[Evaluation]:
    """Run what a name stands for on variations: a program in each of the semantics, or a model.

    :param source: from :func:`find_source`
    :param variations: one for each row of the result
    :param n_episodes: on each
    :param semantics: of a program; crisp is how it is read
    :param env_id: in place of the environment that it was trained in
    :param arguments: further ones of :func:`~sb3_progpolicy.evaluate_program`
    :raises ValueError: if the environment is not known
    """
    from sb3_progpolicy.evaluation import evaluate_model, evaluate_program

    source = source.within(env_id)
    assert source.env_id is not None
    common: dict[str, Any] = {"env_kwargs": source.env_kwargs, **arguments}
    if source.program is None:
        assert source.model is not None
        return evaluate_model(source.model, source.env_id, variations, n_episodes, **common)
    return [
        row
        for kind in semantics
        for row in evaluate_program(source.program, source.env_id, variations, n_episodes, kind, **common)
    ]


def _from_program(name: str, program: Program, env_kwargs: dict[str, Any] | None = None) -> Source:
    env_id = program.metadata.get("env")
    if env_id is not None and not isinstance(env_id, str):
        raise ValueError(f"{name}: metadata: env={env_id!r} is not accepted; it is an environment id")
    return Source(name, env_id, program, None, {**own_env_kwargs(program), **(env_kwargs or {})}, env_id)


def _from_run(folder: Path, allow_pickle: bool) -> Source:
    """A run's program comes from its own file, or from the model if a process was killed between the two."""
    from sb3_progpolicy.experiment.folder import MODEL, PROGRAM, read_config, timesteps_of

    config = read_config(folder)
    if (folder / PROGRAM).is_file():
        program = load_program(folder / PROGRAM)
        if timesteps_of(folder / MODEL) in (None, program.metadata.get("timesteps")):
            return _from_program(str(folder), program, dict(config.env_kwargs))
    if not (folder / MODEL).is_file():
        raise ValueError(f"{folder} holds no model yet")
    return replace(_from_model(folder / MODEL, allow_pickle), name=str(folder))


def _from_model(path: Path, allow_pickle: bool) -> Source:
    from sb3_progpolicy.experiment.folder import CONFIG, load_model, read_config
    from sb3_progpolicy.extraction import extract_program, holds_program

    config = read_config(path.parent) if (path.parent / CONFIG).is_file() else None
    try:
        model = load_model(path, device="cpu", allow_pickle=allow_pickle)
    except ValueError:
        raise
    except Exception as error:  # unpickling a damaged file may raise anything
        raise ValueError(f"{path} is not a model that can be loaded: {error}") from None
    env_kwargs = dict(config.env_kwargs if config else getattr(model, "env_kwargs", {}))
    named = config.env if config else getattr(model, "env_id", None)
    env_id = named if config else id_from_file(named)
    if holds_program(model):
        return replace(_from_program(str(path), extract_program(model, env=named), env_kwargs), env_id=env_id)
    return Source(str(path), env_id, None, model, env_kwargs, named)
