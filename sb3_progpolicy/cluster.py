"""A Ray cluster: one that runs already, or one that is started on this machine."""

from __future__ import annotations

import logging
from typing import Any


def join_cluster(address: str | None = None, n_cores: int | None = None) -> tuple[Any, bool]:
    """Return Ray's module, connected to a cluster, and whether it was connected here, so that it is to be shut down.

    :param address: of a cluster, such as ``"auto"``; ``None`` for the one that ``RAY_ADDRESS`` names, or a new one here
    :param n_cores: of a new cluster; all by default
    :raises ValueError: if Ray is not installed, or the cluster cannot be reached
    """
    try:
        import ray
    except ModuleNotFoundError:
        raise ValueError('Ray is missing: pip install "sb3-progpolicy[ray]"') from None
    if ray.is_initialized():
        return ray, False
    own: dict[str, Any] = {} if address else {"include_dashboard": False}
    if n_cores is not None and not address:
        own["num_cpus"] = n_cores
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **own)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise ValueError(f"the Ray cluster {address or 'here'} cannot be used: {error}") from None
    return ray, True
