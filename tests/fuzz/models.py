"""Damaged and hostile model files: each is refused with a ``ValueError``, or loads as a model of finite numbers."""

from __future__ import annotations

import copy
import io
import json
import random
import warnings
import zipfile
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
import torch as th

from sb3_progpolicy import ReptilePPO, TaskDistribution
from sb3_progpolicy.reptile_ppo.saving import DOCUMENT, TENSORS

# What stands in the place of some value of the JSON.
VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 0.5, -1e300, 1e300, 2**31, 2**63, 10**30, "", "x", "../../x", "/etc/passwd", "NaN"),
    *([], {}, [[]], [0] * 1000, {"__kind__": "class", "name": "os.system"}, {"__kind__": "class", "name": "Adam"}),
    *(
        {"__kind__": "class", "name": ["ReLU"]},
        {"__kind__": "float", "value": "nan"},
        {"__kind__": []},
        {"__kind__": "pickle"},
    ),
    {"__kind__": "array", "dtype": "object", "shape": [1], "items": [0]},
    {"__kind__": "array", "dtype": "float32", "shape": [10**12], "items": [0]},
    {"__kind__": "discrete", "n": 10**12, "start": 0},
    {"__kind__": "box", "low": 0, "high": 1},
    {"__kind__": "linear_schedule", "start": 0, "end": 0, "end_fraction": 0},
)
NAMES = ("../../evil", "/tmp/evil", "data", "policy.pth", "tasks.pkl", "x" * 300, DOCUMENT, TENSORS)


def make_model() -> ReptilePPO:
    """A small model with everything that a file can hold."""
    tasks = TaskDistribution({"n_discs": [1, 2]}, sampler="failure")
    model = ReptilePPO("ProgPolicy", "Hanoi-v0", n_envs=2, n_steps=8, seed=0, tasks=tasks, meta_optimizer="adam",
                       inner_updates=1, normalize_observations=True, scale_rewards=True,
                       search_method="growth", growth_iterations=3,
                       policy_kwargs={"net_arch": [8], "activation_fn": th.nn.Tanh})  # fmt: skip
    model.learn(1100)
    assert model.growth is not None
    assert model.growth.arm is not None, "a trial is open"
    return model


def write(entries: list[tuple[str, bytes]], compression: int = zipfile.ZIP_STORED) -> bytes:
    """Return a zip; names may repeat."""
    buffer = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(buffer, "w", compression) as archive:
        warnings.simplefilter("ignore")
        for name, content in entries:
            archive.writestr(name, content)
    return buffer.getvalue()


def flip(rng: random.Random, content: bytes) -> bytes:
    """Change, cut or repeat a few bytes."""
    raw = bytearray(content)
    for _ in range(rng.randint(1, 8)):
        at = rng.randrange(len(raw))
        raw[at] = rng.randrange(256)
    cut = rng.random()
    if cut < 0.2:
        return bytes(raw[: rng.randrange(len(raw))])
    return bytes(raw) if cut < 0.8 else bytes(raw[: rng.randrange(len(raw))] + raw)


def mutate_json(rng: random.Random, document: Any) -> None:
    """Replace, remove or add something at a random place."""
    at = document
    while True:
        keys = list(at) if isinstance(at, dict) else list(range(len(at)))
        key = rng.choice(keys)
        if isinstance(at[key], (dict, list)) and at[key] and rng.random() < 0.8:
            at = at[key]
            continue
        choice = rng.random()
        if choice < 0.1:
            del at[key]
        elif choice < 0.15 and isinstance(at, dict):
            at[rng.choice(["__class__", "policy", "learn", "x"])] = copy.deepcopy(rng.choice(VALUES))
        else:
            at[key] = copy.deepcopy(rng.choice(VALUES))
        return


def mutate_tensors(rng: random.Random, content: bytes) -> bytes:
    """Rename, reshape, retype, drop or spoil one of the tensors."""
    tensors = dict(safetensors.numpy.load(content))
    name = rng.choice([name for name in tensors if not name.startswith("rollout")])
    array = tensors.pop(name).copy()
    spoilt = array.astype("float32").ravel()
    spoilt[rng.randrange(len(spoilt))] = rng.choice([float("nan"), float("inf")])
    tensors |= rng.choice([
        {},
        {name + "x": array},
        {"policy.optimizer/99/exp_avg": array, name: array},
        {"policy.optimizer/x/exp_avg": array, name: array},
        {name: array[None]},
        {name: array.astype("float64" if array.dtype != "float64" else "float16")},
        {name: array.ravel()[:0]},
        {name: spoilt.reshape(array.shape)},
    ])  # fmt: skip
    return safetensors.numpy.save(tensors)


def mutate(rng: random.Random, content: bytes) -> tuple[str, bytes]:
    """Return what kind of damage, and the damaged file."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        document, tensors = archive.read(DOCUMENT), archive.read(TENSORS)
    kind = rng.choice(["bytes", "json", "json", "json text", "tensors", "tensor bytes", "entries", "sizes"])
    if kind == "bytes":
        return kind, flip(rng, content)
    if kind == "json":
        data = json.loads(document)
        for _ in range(rng.randint(1, 3)):
            mutate_json(rng, data)
        document = json.dumps(data).encode()
    elif kind == "json text":
        nested, depth = rng.choice([(b"[", b"]"), (b'{"a":', b"}")]), rng.choice([100, 3000, 100_000])
        deep = nested[0] * depth + b"0" + nested[1] * depth
        huge = b'{"a":[' + b"[]," * 1_000_000 + b"0]}"
        twice = document.replace(b'"n_steps": 8', b'"n_steps": 8, "n_steps": 8')
        into = document.replace(b'"env_kwargs": {}', b'"env_kwargs": {"x": ' + deep + b"}")
        document = rng.choice([flip(rng, document), deep, into, huge, twice, b"", b"1" * 5000])
    elif kind == "tensors":
        tensors = mutate_tensors(rng, tensors)
    elif kind == "tensor bytes":
        tensors = flip(rng, tensors[:2000]) + tensors[2000:]
    entries = [(DOCUMENT, document), (TENSORS, tensors)]
    if kind == "entries":
        entries.insert(rng.randrange(3), (rng.choice(NAMES), rng.choice([b"", b"x", document])))
        entries = entries if rng.random() < 0.8 else entries[: rng.randint(0, 2)]
    compression = zipfile.ZIP_DEFLATED if kind == "sizes" else zipfile.ZIP_STORED
    if kind == "sizes" and rng.random() < 0.5:
        entries[rng.randrange(2)] = (rng.choice([DOCUMENT, TENSORS]), bytes(5_000_000))
    return kind, write(entries, compression)


@lru_cache
def saved() -> bytes:
    """The file that is damaged."""
    buffer = io.BytesIO()
    make_model().save(buffer)
    return buffer.getvalue()


def case(rng: np.random.Generator, folder: Path) -> str:
    """Load one damaged file and return what came of it.

    :raises AssertionError: if it is neither refused with a ``ValueError`` nor loaded as a sound model
    """
    kind, damaged = mutate(random.Random(int(rng.integers(2**32))), saved())
    path = folder / "model.zip"
    path.write_bytes(damaged)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = ReptilePPO.load(path)
    except ValueError as error:
        outcome, message = f"{kind}: refused", str(error)
    else:
        assert all(tensor.isfinite().all() for tensor in model.policy.state_dict().values())
        outcome, message = f"{kind}: loaded", "loaded"
    assert 0 < len(message) < 3000, message[:200]
    assert [entry.name for entry in folder.iterdir()] == ["model.zip"], "something was extracted"
    return outcome
