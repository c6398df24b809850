"""The arguments of policies, checked by name before torch says something of its own about them."""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Integral
from typing import Any

from torch import nn

from sb3_progpolicy.bounds import check_whole
from sb3_progpolicy.differentiable.conditions import CELLS

_NETWORKS = ("pi", "vf", "qf")


def check_policy_kwargs(given: Mapping[str, Any]) -> None:
    """Check those of ``policy_kwargs`` that give sizes and kinds.

    :param given: arguments by name
    :raises ValueError: naming the first that is not accepted, and what is
    """
    for name in ("depth", "condition_size"):
        if name in given:
            check_whole(name, given[name], 1)
    if given.get("n_conditions") is not None:
        check_whole("n_conditions", given["n_conditions"], 0)
    if "cell" in given and (not isinstance(given["cell"], str) or given["cell"] not in CELLS):
        raise ValueError(f"cell={given['cell']!r} is not accepted; known cells: {', '.join(CELLS)}")
    _check_net_arch(given.get("net_arch"))
    activation = given.get("activation_fn", nn.Tanh)
    if not (isinstance(activation, type) and issubclass(activation, nn.Module)):
        raise ValueError(
            f"activation_fn={activation!r} is not accepted; it is a class of torch.nn, such as torch.nn.Tanh, and not "
            "given in a file or on the command line"
        )


def _check_net_arch(net_arch: Any) -> None:
    unpacked = net_arch[0] if isinstance(net_arch, list) and len(net_arch) == 1 else net_arch  # SB3's form before 1.8
    named = unpacked if isinstance(unpacked, Mapping) else {"vf": net_arch}
    for layers in named.values():
        if layers is None:
            continue
        if not _are_sizes(layers) or not set(named) <= set(_NETWORKS):
            raise ValueError(
                f"net_arch={net_arch!r} is not accepted; it is a list of layer sizes, such as [64, 64], or a mapping "
                f"of such lists by network ({', '.join(_NETWORKS)})"
            )


def _are_sizes(layers: Any) -> bool:
    return isinstance(layers, (list, tuple)) and all(
        isinstance(size, Integral) and not isinstance(size, bool) and int(size) > 0 for size in layers
    )
