"""Networks of discrete soft actor-critic: a categorical actor, and critics with one Q-value for each action."""

from __future__ import annotations

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel, BasePolicy
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    FlattenExtractor,
    NatureCNN,
    create_mlp,
    get_actor_critic_arch,
)
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn


class DiscreteActor(BasePolicy):
    """Network from observations to the log-probabilities of all actions.

    :param observation_space: of the environment
    :param action_space: ``Discrete``; its ``start`` need not be 0
    :param net_arch: units of the hidden layers
    :param features_extractor: before the network
    :param features_dim: number of features that it returns
    :param activation_fn: between layers
    :param normalize_images: whether images are divided by 255
    """

    action_space: spaces.Discrete

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Discrete,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.ReLU,
        normalize_images: bool = True,
    ) -> None:
        super().__init__(
            observation_space, action_space, features_extractor=features_extractor, normalize_images=normalize_images
        )
        self.net_arch, self.features_dim, self.activation_fn = net_arch, features_dim, activation_fn
        self.logits = nn.Sequential(*create_mlp(features_dim, int(action_space.n), net_arch, activation_fn))

    def log_probs(self, obs: PyTorchObs) -> th.Tensor:
        """Return the log-probabilities of all actions, ``(batch, n_actions)``."""
        return th.log_softmax(self.logits(self.extract_features(obs, self.features_extractor)), dim=1)

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """Return actions, ``(batch,)``: drawn, or the most likely ones.

        :raises FloatingPointError: if an observation or a parameter is not finite
        """
        log_probs = self.log_probs(obs)
        if not bool(th.isfinite(log_probs).all()):
            raise FloatingPointError(
                "the probabilities of actions are not finite; an observation or a parameter is not"
            )
        chosen = log_probs.argmax(dim=1) if deterministic else th.multinomial(log_probs.exp(), 1).squeeze(1)
        return chosen + int(self.action_space.start)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self(observation, deterministic)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **super()._get_constructor_parameters(),
            "net_arch": self.net_arch,
            "features_dim": self.features_dim,
            "activation_fn": self.activation_fn,
            "features_extractor": self.features_extractor,
        }


class DiscreteCritic(BaseModel):
    """Several networks from observations to the Q-values of all actions, behind one features extractor.

    :param observation_space: of the environment
    :param action_space: ``Discrete``
    :param net_arch: units of the hidden layers
    :param features_extractor: before the networks
    :param features_dim: number of features that it returns
    :param activation_fn: between layers
    :param normalize_images: whether images are divided by 255
    :param n_critics: number of networks
    :param share_features_extractor: whether the extractor is the actor's, and trained by the actor's loss alone
    """

    features_extractor: BaseFeaturesExtractor

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Discrete,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.ReLU,
        normalize_images: bool = True,
        n_critics: int = 2,
        share_features_extractor: bool = False,
    ) -> None:
        super().__init__(
            observation_space, action_space, features_extractor=features_extractor, normalize_images=normalize_images
        )
        self.share_features_extractor = share_features_extractor
        self.q_networks = nn.ModuleList(
            nn.Sequential(*create_mlp(features_dim, int(action_space.n), net_arch, activation_fn))
            for _ in range(n_critics)
        )

    def forward(self, obs: PyTorchObs) -> tuple[th.Tensor, ...]:
        """Return each network's Q-values, ``(batch, n_actions)``."""
        with th.set_grad_enabled(th.is_grad_enabled() and not self.share_features_extractor):
            features = self.extract_features(obs, self.features_extractor)
        return tuple(network(features) for network in self.q_networks)


class DiscreteSACPolicy(BasePolicy):
    """Actor, critics and target critics of :class:`~sb3_progpolicy.DiscreteSAC`; arguments as of SB3's ``SACPolicy``.

    :param observation_space: of the environment
    :param action_space: ``Discrete``
    :param lr_schedule: learning rate as a function of the progress remaining
    :param net_arch: units of the hidden layers, or ``{"pi": [...], "qf": [...]}``; by default 256, 256, none behind a
        CNN
    :param activation_fn: between layers
    :param features_extractor_class: before the networks
    :param features_extractor_kwargs: its arguments
    :param normalize_images: whether images are divided by 255
    :param optimizer_class: of actor and critics
    :param optimizer_kwargs: its arguments besides the learning rate
    :param n_critics: number of critics
    :param share_features_extractor: whether actor and critics share theirs
    """

    actor: DiscreteActor
    critic: DiscreteCritic
    critic_target: DiscreteCritic
    action_space: spaces.Discrete

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Discrete,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        features_extractor_class: type[BaseFeaturesExtractor] = FlattenExtractor,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        n_critics: int = 2,
        share_features_extractor: bool = False,
    ) -> None:
        super().__init__(
            observation_space,
            action_space,
            features_extractor_class,
            features_extractor_kwargs,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            normalize_images=normalize_images,
        )
        if net_arch is None:
            net_arch = [] if features_extractor_class is NatureCNN else [256, 256]
        self.net_arch, self.activation_fn = net_arch, activation_fn
        self.n_critics, self.share_features_extractor = n_critics, share_features_extractor
        self._build(lr_schedule)

    def _build(self, lr_schedule: Schedule) -> None:
        actor_arch, critic_arch = get_actor_critic_arch(self.net_arch)
        common: dict[str, Any] = {
            "observation_space": self.observation_space,
            "action_space": self.action_space,
            "activation_fn": self.activation_fn,
            "normalize_images": self.normalize_images,
        }
        critic = {
            **common,
            "net_arch": critic_arch,
            "n_critics": self.n_critics,
            "share_features_extractor": self.share_features_extractor,
        }
        self.actor = DiscreteActor(**self._update_features_extractor({**common, "net_arch": actor_arch}))
        shared = self.actor.features_extractor if self.share_features_extractor else None
        self.critic = DiscreteCritic(**self._update_features_extractor(critic, shared))
        self.critic_target = DiscreteCritic(**self._update_features_extractor(critic))
        self.critic_target.load_state_dict(self.critic.state_dict())
        self.critic_target.set_training_mode(False)
        self.actor.optimizer = self._make_optimizer(self.actor.parameters(), lr_schedule)
        # A shared extractor is the actor's to train, as in SB3's SAC.
        own = [p for name, p in self.critic.named_parameters() if shared is None or "features_extractor" not in name]
        self.critic.optimizer = self._make_optimizer(own, lr_schedule)

    def _make_optimizer(self, parameters: Any, lr_schedule: Schedule) -> th.optim.Optimizer:
        return self.optimizer_class(parameters, lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """Return actions, ``(batch,)``: drawn, or the most likely ones."""
        return self._predict(obs, deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self.actor(observation, deterministic)

    def set_training_mode(self, mode: bool) -> None:
        """Switch batch normalisation and dropout; the target stays in evaluation mode.

        :param mode: whether for training
        """
        self.actor.set_training_mode(mode)
        self.critic.set_training_mode(mode)
        self.training = mode

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **super()._get_constructor_parameters(),
            "net_arch": self.net_arch,
            "activation_fn": self.activation_fn,
            "lr_schedule": self._dummy_schedule,
            "optimizer_class": self.optimizer_class,
            "optimizer_kwargs": self.optimizer_kwargs,
            "features_extractor_class": self.features_extractor_class,
            "features_extractor_kwargs": self.features_extractor_kwargs,
            "n_critics": self.n_critics,
            "share_features_extractor": self.share_features_extractor,
        }


class MlpPolicy(DiscreteSACPolicy):
    """For observations that are vectors."""


class CnnPolicy(DiscreteSACPolicy):
    """For images."""

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Discrete,
        lr_schedule: Schedule,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            observation_space, action_space, lr_schedule, **{"features_extractor_class": NatureCNN, **kwargs}
        )


class MultiInputPolicy(DiscreteSACPolicy):
    """For observations that are dictionaries."""

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Discrete,
        lr_schedule: Schedule,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            observation_space, action_space, lr_schedule, **{"features_extractor_class": CombinedExtractor, **kwargs}
        )
