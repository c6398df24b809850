"""Controllers whose weights a group of symmetries ties."""

from __future__ import annotations

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from sb3_progpolicy.symmetries import Ties


class TiedLinear(nn.Module):
    """Several affine maps that stay as they are under a group of symmetries, whatever their free numbers.

    Weights and biases are read as those of ``torch.nn.Linear``, the maps one after the other.

    :param ties: which weights are one number
    :param n_maps: how many maps
    """

    def __init__(self, ties: Ties, n_maps: int) -> None:
        super().__init__()
        self._index: th.Tensor
        self._sign: th.Tensor
        self.register_buffer("_index", th.from_numpy(ties.index.ravel()), persistent=False)
        self.register_buffer("_sign", th.from_numpy(ties.sign), persistent=False)
        #: The free numbers of each map, ``(n_maps, n_free)``.
        self.free = nn.Parameter(th.zeros(n_maps, ties.n_free))

    @property
    def weight(self) -> th.Tensor:
        """``(n_maps * n_outputs, n_inputs)``."""
        return self.expand()[0]

    @property
    def bias(self) -> th.Tensor:
        """``(n_maps * n_outputs,)``."""
        return self.expand()[1]

    def ties_of_weights(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return which free number each weight and bias is, and its sign, both ``(n_outputs, n_inputs + 1)``."""
        sign = self._sign.cpu().numpy().astype(np.float64)
        return self._index.cpu().numpy().reshape(sign.shape), sign

    def expand(self) -> tuple[th.Tensor, th.Tensor]:
        """Return weights and biases, both of one computation."""
        weights = self.free.index_select(1, self._index).unflatten(1, self._sign.shape) * self._sign
        rows = weights.flatten(0, 1)
        return rows[:, :-1], rows[:, -1]

    @th.no_grad()
    def set_(self, weights: th.Tensor) -> None:
        """Set the weights to the symmetric part of a matrix, and the biases to 0.

        :param weights: ``(n_maps * n_outputs, n_inputs)``
        """
        n_outputs, width = self._sign.shape
        rows = th.cat((weights.cpu(), th.zeros(len(weights), 1)), dim=1)
        assert rows.shape == (len(self.free) * n_outputs, width)
        signed = (rows.unflatten(0, (-1, n_outputs)) * self._sign.cpu()).flatten(1)
        sums = th.zeros(self.free.shape).index_add_(1, self._index.cpu(), signed)
        sizes = th.zeros(self.free.shape[1]).index_add_(0, self._index.cpu(), self._sign.cpu().abs().flatten())
        self.free.copy_(sums / sizes.clamp_min(1))

    def orthogonal_(self, gain: float) -> None:
        """Set the weights to the symmetric part of an orthogonal matrix, as SB3 begins, and the biases to 0.

        :param gain: of the orthogonal matrix
        """
        n_outputs, width = self._sign.shape
        self.set_(nn.init.orthogonal_(th.empty(len(self.free) * n_outputs, width - 1), gain))
