"""Actions as labels, and outputs as actions."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_progpolicy.imitation.decision_list import DecisionList, Floats
from sb3_progpolicy.imitation.losses import BoxLoss, DiscreteLoss, Loss
from sb3_progpolicy.spaces import ActionSpec


class ActionCodec:
    """Scales Box actions to [-1, 1] and writes Discrete ones as one 1 among zeros.

    :param spec: the action space
    :param names: one for each output
    :raises ValueError: if the space is neither a Box with bounds nor Discrete
    """

    def __init__(self, spec: ActionSpec, names: tuple[str, ...]) -> None:
        if spec.kind not in ("box", "discrete"):
            raise ValueError(
                f"{spec.kind} actions are not accepted here; Box and Discrete ones are. A MultiDiscrete space can be "
                "written as one Discrete space of all combinations"
            )
        self.spec, self.names = spec, names
        low, high = np.array(spec.low), np.array(spec.high)
        if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
            raise ValueError(
                f"Box actions from {low.tolist()} to {high.tolist()} are not accepted; each number has finite bounds, "
                "the lower one below the upper one"
            )
        self.middle, self.half = (low + high) / 2, (high - low) / 2
        #: Size of a large output, ``(n_outputs,)``.
        self.unit = self.half if spec.kind == "box" else np.ones(spec.n_outputs)

    def loss(self) -> Loss:
        """Return the loss of this action space; outputs named ``move_x``, ``move_y`` ... are one vector.

        :raises ImportError: if the actions are Discrete and SciPy is missing
        """
        if self.spec.kind == "discrete":
            if importlib.util.find_spec("scipy") is None:
                raise ImportError('imitate with Discrete actions needs SciPy: pip install "sb3-progpolicy[imitation]"')
            return DiscreteLoss()
        moves = tuple(index for index, name in enumerate(self.names) if name.startswith("move_"))
        return BoxLoss(np.ones(self.spec.n_outputs, dtype=bool), moves if len(moves) > 1 else ())

    def encode(self, actions: NDArray[Any]) -> Floats:
        """Return labels ``(n, n_outputs)``."""
        if self.spec.kind == "discrete":
            return np.eye(self.spec.sizes[0])[np.asarray(actions, dtype=np.int64).ravel() - self.spec.start]
        scaled = (np.asarray(actions, dtype=np.float64).reshape(len(actions), -1) - self.middle) / self.half
        return np.clip(scaled, -1, 1)

    def decode(self, outputs: Floats) -> NDArray[Any]:
        """Return actions for the outputs of controllers that were fitted to labels, ``(n, n_outputs)``."""
        if self.spec.kind == "discrete":
            return outputs.argmax(axis=1) + self.spec.start
        return (np.clip(outputs, -1, 1) * self.half + self.middle).astype(np.float32)

    def act_of(self, raw: DecisionList) -> Callable[[NDArray[np.floating]], NDArray[Any]]:
        """Return a list on raw observations as a function from observations to actions."""

        def act(inputs: NDArray[np.floating]) -> NDArray[Any]:
            with_constant = np.column_stack([inputs.astype(np.float64), np.ones(len(inputs))])
            return self.decode(raw.outputs(with_constant))

        return act

    def to_action_units(self, controllers: Floats) -> Floats:
        """Return controllers whose outputs are actions, ``(n_branches, n_outputs, n_inputs + 1)``."""
        if self.spec.kind == "discrete":
            return controllers
        scaled = controllers * self.half[:, None]
        scaled[..., -1] += self.middle
        return scaled

    def distance(self, actions: NDArray[Any], labels: NDArray[Any]) -> Floats:
        """Return how far actions are from labels: 0 or 1 if Discrete, else the mean over numbers, in half ranges."""
        if self.spec.kind == "discrete":
            return (np.asarray(actions).ravel() != np.asarray(labels).ravel()).astype(np.float64)
        return np.asarray(np.abs(self.encode(actions) - self.encode(labels)).mean(axis=1))
