"""Running statistics that travel with the model: of observations, in the policy, and of rewards."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from progpolicy_envs.symmetry import Permutation
from sb3_progpolicy.differentiable.module import ProgramModule

EPSILON = 1e-8
CLIP_REWARD = 10.0  # as VecNormalize's; until the statistics have settled, a scaled reward can be anything


class NormalizingExtractor(BaseFeaturesExtractor):
    """Shifts and scales observations to mean 0 and variance 1 by running statistics kept in its state dict.

    The map is affine and unclipped, so that it can be folded into a program's weights.

    :param observation_space: a one-dimensional Box
    :param ignored: indices of numbers that are 0 in what it returns, so that nothing that reads it depends on them
    """

    def __init__(self, observation_space: spaces.Box, ignored: Sequence[int] = ()) -> None:
        n_features = int(np.prod(observation_space.shape))
        super().__init__(observation_space, n_features)
        self.mean: th.Tensor
        self.variance: th.Tensor
        self.count: th.Tensor
        self.register_buffer("mean", th.zeros(n_features, dtype=th.float64))
        self.register_buffer("variance", th.ones(n_features, dtype=th.float64))
        self.register_buffer("count", th.tensor(EPSILON, dtype=th.float64))
        self._group: Sequence[Permutation] = ()
        read = th.ones(n_features, dtype=th.float64)
        read[list(ignored)] = 0
        self._read: th.Tensor
        self.register_buffer("_read", read, persistent=False)

    def tie(self, group: Sequence[Permutation]) -> None:
        """Keep the statistics those of all images of the observations, so that a tied program stays one.

        :param group: how its members move the observation
        :raises ValueError: if a number that is ignored has an image that is not
        """
        for one in group:
            if not th.equal(self._read[list(one.source)], self._read):
                raise ValueError("ignored inputs have images under the symmetries that are not; ignore these, too")
        self._group = tuple(group)

    @property
    def scale(self) -> th.Tensor:
        """Return ``1 / standard deviation``; 1 where a number has never changed, and 0 where it is ignored."""
        deviation = (self.variance + EPSILON).sqrt()
        return th.where(self.variance > EPSILON, 1 / deviation, 1.0) * self._read

    def update(self, observations: NDArray[np.floating] | th.Tensor) -> None:
        """Take in a batch.

        :param observations: ``(n, n_features)``
        """
        statistics = RunningMeanStd(shape=self.mean.shape)
        statistics.mean, statistics.var = self.mean.cpu().numpy(), self.variance.cpu().numpy()
        statistics.count = float(self.count)
        statistics.update(np.asarray(observations, dtype=np.float64))
        mean, variance = statistics.mean, statistics.var
        if self._group:
            squares = np.mean([(mean**2 + variance)[list(one.source)] for one in self._group], axis=0)
            mean = np.mean([one(mean) for one in self._group], axis=0)
            variance = np.maximum(squares - mean**2, 0)
        self.mean.copy_(th.as_tensor(mean))
        self.variance.copy_(th.as_tensor(variance))
        self.count.fill_(statistics.count)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Return the normalised observations ``(n, n_features)``."""
        return ((observations.flatten(1) - self.mean) * self.scale).to(observations.dtype)

    @th.no_grad()
    def fold_into(self, module: ProgramModule) -> None:
        """Change a program's weights so that it computes on raw numbers what it computed on normalised ones.

        :param module: whose first layers read this extractor's output
        """
        pairs = [(module.controllers.weight, module.controllers.bias)]
        if module.conditions.recurrent:
            pairs.append((module.conditions.rnn.weight_ih_l0, module.conditions.rnn.bias_ih_l0))  # type: ignore[arg-type]
        elif module.conditions.n_conditions:
            pairs.append((module.conditions.affine.weight, module.conditions.affine.bias))
        for weight, bias in pairs:
            folded = weight.double() * self.scale
            bias.copy_(bias.double() - folded @ self.mean)
            weight.copy_(folded)


class RewardScaler:
    """Divides rewards by the running standard deviation of the discounted return, as SB3's ``VecNormalize`` does.

    :param gamma: discount factor
    """

    def __init__(self, gamma: float) -> None:
        self.gamma = gamma
        self.statistics = RunningMeanStd(shape=())
        self._returns: NDArray[np.float64] = np.zeros(0)

    def __call__(self, rewards: NDArray[np.floating], dones: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Take in the rewards of one step and return them scaled, within -10 and 10.

        :param rewards: ``(n_envs,)``
        :param dones: ``(n_envs,)``, whether the episode ended with this step
        """
        if len(self._returns) != len(rewards):
            self._returns = np.zeros(len(rewards))
        self._returns = self._returns * self.gamma + rewards
        self.statistics.update(self._returns)
        self._returns[dones] = 0
        scaled = rewards / np.sqrt(self.statistics.var + EPSILON)
        return np.clip(scaled, -CLIP_REWARD, CLIP_REWARD).astype(np.float32)

    def state(self) -> list[float]:
        """Return the statistics: mean, variance and number of the returns."""
        return [float(x) for x in (self.statistics.mean, self.statistics.var, self.statistics.count)]

    def restore(self, state: Sequence[float]) -> None:
        """Take over what :meth:`state` has returned."""
        mean, variance, count = map(np.float64, state)
        self.statistics.mean, self.statistics.var, self.statistics.count = mean, variance, float(count)

    def reset_returns(self) -> None:
        """Start the running returns anew, as at a task switch; the statistics stay."""
        self._returns = np.zeros(0)
