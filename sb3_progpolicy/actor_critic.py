"""What both programmatic policies share: the actor is a program, the critic a small network."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from typing import Any, TypeVar, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import (
    CategoricalDistribution,
    DiagGaussianDistribution,
    Distribution,
    MultiCategoricalDistribution,
)
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from progpolicy_envs.symmetry import Symmetry
from sb3_progpolicy.differentiable.conditions import State
from sb3_progpolicy.differentiable.module import ProgramModule
from sb3_progpolicy.differentiable.tied import TiedLinear
from sb3_progpolicy.distributions import BranchMixture, NormalizedCategorical
from sb3_progpolicy.normalization import NormalizingExtractor
from sb3_progpolicy.policy_arguments import check_policy_kwargs
from sb3_progpolicy.programs.program import Program
from sb3_progpolicy.programs.syntax import BoxSemantics, Cell
from sb3_progpolicy.programs.validation import check_size
from sb3_progpolicy.spaces import ActionSpec, action_spec, check_observation_space, ends_with_history

# W is one number per layer and has few updates to decide in, so that it takes larger steps than the controllers. So it
# is in ReptilePPO; in stock algorithms SB3 gives all parameters the same rate at every update.
DERIVATION_LR_SCALE = 10.0
_FOR_REPTILE_PPO: ContextVar[bool] = ContextVar("for_reptile_ppo", default=False)


@contextmanager
def for_reptile_ppo() -> Iterator[None]:
    """Let policies be made that stock algorithms cannot train.

    ReptilePPO adds the first action of a Discrete space to what a policy chooses, and updates the statistics of
    :class:`NormalizingExtractor`; stock algorithms do neither.
    """
    token = _FOR_REPTILE_PPO.set(True)
    try:
        yield
    finally:
        _FOR_REPTILE_PPO.reset(token)


SelfPolicy = TypeVar("SelfPolicy", bound="ProgrammaticActorCritic")


class ProgrammaticActorCritic(ActorCriticPolicy):
    """What both programmatic policies share: the program as the actor and an MLP on the same features as the critic.

    Programs read one-dimensional Box observations and act in Discrete, Box, MultiDiscrete and MultiBinary spaces.

    :param observation_space: of the environment, with the interaction history if it is appended
    :param action_space: of the environment
    :param lr_schedule: learning rate schedule
    :param depth: layers of the derivation graph, at least 1; programs have up to ``depth - 1`` conditions
    :param cell: ``"gru"``, ``"lstm"``, ``"rnn"``, ``"affine"``, or ``"min"``, the least of several affine sums
    :param condition_size: hidden units per condition, or sums of a ``"min"``
    :param temperature: of the sigmoid in the soft semantics, above 0
    :param semantics: what a soft program does with Box actions: ``"branches"`` draws one controller, ``"means"`` mixes
        the controllers' outputs, as in the paper; discrete actions are drawn either way
    :param n_conditions: fixes the program's number of conditions from the start, in place of ``depth`` and the search
    :param symmetries: generators of the symmetries over which the program's weights are tied (see
        :class:`~sb3_progpolicy.symmetries.Group`), each a :class:`progpolicy_envs.Symmetry` or its plain data. The
        critic is not tied
    :param persistence_init: what each action's score reads of having been taken before, at the start (for Box actions,
        what each output reads of its previous value): exploration that keeps its way for some steps, as in Dabney et
        al. (2021), but by the policy itself, so that PPO's ratios hold and training can undo it. The last inputs have
        to be the interaction history, as in ReptilePPO and behind :class:`VecInteractionHistory`
    :param net_arch: hidden layers of the critic, a list or ``dict(vf=[...])``
    :param activation_fn: of the critic
    :param log_std_init: initial logarithm of the standard deviation of Box actions
    :param optimizer_class: of the inner updates
    :param optimizer_kwargs: of the optimizer; for Adam ``eps=1e-5`` and the fused kernel by default
    :param reset_state_at_episode_start: zero the conditions' states when an episode starts; by default they survive
        it, and only the caller's ``state=None`` (or a task switch in ``ReptilePPO``) zeroes them (section 2.4). With
        ``True``, which ``ReptilePPO`` does not take, no program is extracted, for it does not forget
    :param kwargs: further arguments of SB3's ``ActorCriticPolicy``; ``features_extractor_class=NormalizingExtractor``
        is for ReptilePPO alone, as are Discrete actions that do not start at 0
    :raises ValueError: if a space or a value is not accepted, or the program would be too large to print
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        depth: int = 3,
        cell: Cell = "gru",
        condition_size: int = 1,
        temperature: float = 1.0,
        semantics: BoxSemantics = "means",
        n_conditions: int | None = None,
        symmetries: Sequence[Symmetry | Mapping[str, Any]] = (),
        persistence_init: float = 0.0,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        log_std_init: float = 0.0,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        reset_state_at_episode_start: bool = False,
        **kwargs: Any,
    ) -> None:
        check_observation_space(observation_space)
        check_policy_kwargs(locals())
        if temperature <= 0:
            raise ValueError(f"temperature={temperature} is not accepted; it is above 0")
        if not math.isfinite(persistence_init):
            raise ValueError(f"persistence_init={persistence_init} is not accepted; it is a finite number")
        extractor = kwargs.get("features_extractor_class", FlattenExtractor)
        if extractor not in (FlattenExtractor, NormalizingExtractor):
            raise ValueError(
                f"features_extractor_class={extractor.__name__} is not accepted; a program reads what it is printed to "
                "read. FlattenExtractor is accepted, and NormalizingExtractor, which is folded into the program"
            )
        if isinstance(net_arch, list) and net_arch and isinstance(net_arch[0], dict):
            warnings.warn(f"net_arch={net_arch} is SB3's form before 1.8; give the dict without a list", stacklevel=2)
            net_arch = net_arch[0]
        if isinstance(net_arch, dict):
            if net_arch.get("pi"):
                raise ValueError(f"net_arch={net_arch} is not accepted; the actor is a program, 'vf' is the critic's")
            net_arch = net_arch.get("vf", [])
        if kwargs.pop("use_sde", False):
            raise ValueError("use_sde=True is not accepted; a program's Box actions have a state-independent noise")
        self.program_kwargs: dict[str, Any] = {
            "depth": depth,
            "cell": cell,
            "condition_size": condition_size,
            "temperature": temperature,
            "semantics": semantics,
            "symmetries": symmetries,
        }
        self.n_conditions, self.persistence_init = n_conditions, persistence_init
        if n_conditions is not None:
            self.program_kwargs["depth"] = n_conditions + 1
        self.spec_of_actions: ActionSpec = action_spec(action_space)
        n_inputs = int(np.prod(observation_space.shape or ()))
        check_size(n_inputs, self.spec_of_actions, self.program_kwargs["depth"] - 1, cell, condition_size)
        self._check_algorithm(action_space, extractor)
        if persistence_init and not ends_with_history(observation_space, self.spec_of_actions):
            raise ValueError(
                f"persistence_init={persistence_init} is not accepted; the last inputs are not the previous action, "
                "reward and done flag. VecInteractionHistory around the environment appends them"
            )
        self.reset_state_at_episode_start = reset_state_at_episode_start
        if optimizer_kwargs is None and optimizer_class is th.optim.Adam:
            # SB3's epsilon for PPO, and one kernel for all parameters.
            optimizer_kwargs = {"eps": 1e-5, "fused": True}
        # Past RecurrentActorCriticPolicy's own constructor, which would build two LSTMs that no program uses.
        ActorCriticPolicy.__init__(
            self,
            observation_space,
            action_space,
            lr_schedule,
            net_arch={"pi": [], "vf": [64, 64] if net_arch is None else net_arch},
            activation_fn=activation_fn,
            log_std_init=log_std_init,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            **kwargs,
        )

    @staticmethod
    def _check_algorithm(action_space: spaces.Space[Any], extractor: type[nn.Module]) -> None:
        """Raise ``ValueError`` for what a stock algorithm would do wrong without a word."""
        if _FOR_REPTILE_PPO.get():
            return
        if isinstance(action_space, spaces.Discrete) and action_space.start != 0:
            raise ValueError(
                f"action space {action_space} is not accepted; Stable-Baselines3's algorithms give the environment "
                f"actions from 0 on, where the program acts from {action_space.start} on. ReptilePPO takes such spaces"
            )
        if extractor is NormalizingExtractor:
            raise ValueError(
                "features_extractor_class=NormalizingExtractor is not accepted here; only ReptilePPO updates its "
                "statistics. Put VecNormalize around the environment, which is folded into the program, too"
            )

    @classmethod
    def load(cls: type[SelfPolicy], path: str, device: th.device | str = "auto") -> SelfPolicy:
        """Load a policy that was saved alone, by whichever algorithm. See SB3's ``BaseModel.load``."""
        with for_reptile_ppo():
            return super().load(path, device)

    def _build(self, lr_schedule: Schedule) -> None:
        """Build the program, the critic and the optimizer."""
        self.mlp_extractor = MlpExtractor(self.features_dim, self.net_arch, self.activation_fn, self.device)
        self.module = ProgramModule(self.features_dim, self.spec_of_actions, **self.program_kwargs)
        self.value_net = nn.Linear(self.mlp_extractor.latent_dim_vf, 1)
        if self.n_conditions is not None:
            self.module.search.select(self.n_conditions)
        if self.module.mixes_branches:
            self.action_dist = BranchMixture(self.spec_of_actions.n_outputs)
        if self.module.group is not None and isinstance(self.features_extractor, NormalizingExtractor):
            self.features_extractor.tie(self.module.group.inputs)
        if isinstance(self.action_dist, DiagGaussianDistribution):
            self.log_std = nn.Parameter(th.full((self.spec_of_actions.n_outputs,), self.log_std_init))
        if self.ortho_init:
            # Small controllers, so that all actions are equally likely at the start.
            for layer, gain in ((self.mlp_extractor, 2**0.5), (self.module.controllers, 0.01), (self.value_net, 1.0)):
                if isinstance(layer, TiedLinear):
                    layer.orthogonal_(gain)
                else:
                    layer.apply(partial(self.init_weights, gain=gain))
        if self.persistence_init:
            self.module.keep_action_(self.persistence_init)
        self.optimizer = self.optimizer_class(
            [
                {"params": self.phi(), "lr": lr_schedule(1)},
                {"params": self.derivation_parameters(), "lr": DERIVATION_LR_SCALE * lr_schedule(1)},
            ],
            **self.optimizer_kwargs,
        )

    def derivation_parameters(self) -> list[nn.Parameter]:
        """Return W."""
        return [self.module.search.logits]

    def phi(self) -> list[nn.Parameter]:
        """Return every parameter but W: conditions, controllers, critic."""
        derivation = {id(parameter) for parameter in self.derivation_parameters()}
        return [parameter for parameter in self.parameters() if id(parameter) not in derivation]

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            self.program_kwargs,
            net_arch=cast(dict[str, list[int]], self.net_arch)["vf"],
            reset_state_at_episode_start=self.reset_state_at_episode_start,
            n_conditions=self.n_conditions,
            persistence_init=self.persistence_init,
        )
        # Arguments of SB3's constructor that a program has no use for.
        for name in ("use_sde", "full_std", "use_expln"):
            data.pop(name, None)
        return data

    def set_temperature(self, temperature: float) -> None:
        """Set the temperature of the sigmoid; towards 0 the program decides as its crisp form does.

        :param temperature: above 0
        """
        self.module.temperature.fill_(temperature)

    def set_action_temperature(self, temperature: float) -> None:
        """Set what the logits of discrete actions are divided by; towards 0 the likeliest action is always taken.

        :param temperature: above 0
        """
        self.module.action_temperature.fill_(temperature)

    def program(
        self,
        input_names: tuple[str, ...] | None = None,
        output_names: tuple[str, ...] | None = None,
        interaction: bool | None = None,
        **metadata: Any,
    ) -> Program:
        """Extract the most likely program as plain data (line 10 of algorithm 1).

        An observation normaliser is folded into the weights, so that the program reads raw numbers.

        :param input_names: one name per number of X; ``x[0]``, ``x[1]`` ... if ``None``
        :param output_names: one name per controller output; ``a[0]`` ... if ``None``
        :param interaction: whether X ends with the interaction history
        :param metadata: JSON values to keep with the program
        """
        module = self.module.extract()
        if isinstance(self.features_extractor, NormalizingExtractor):
            self.features_extractor.fold_into(module)
        n_inputs = self.module.n_inputs
        history = self.spec_of_actions.interaction_size
        return Program(
            body=module.to_syntax(),
            n_observations=n_inputs - history if interaction else n_inputs,
            action=self.spec_of_actions,
            interaction=bool(interaction),
            input_names=input_names or tuple(f"x[{i}]" for i in range(n_inputs)),
            output_names=output_names or tuple(f"a[{i}]" for i in range(self.spec_of_actions.n_outputs)),
            temperature=float(self.module.temperature),
            semantics=self.module.semantics,
            metadata=metadata,
        )

    def _distribution(self, features: th.Tensor, condition_values: th.Tensor) -> Distribution:
        """Return the action distribution of the soft semantics."""
        return self._distribution_of(self.module.mix(features, self.module.mixture_weights(condition_values)))

    def _distribution_of(self, parameters: th.Tensor) -> Distribution:
        """Return the distribution with these parameters, ``(n, n_outputs)`` (see ``ProgramModule.mix``)."""
        distribution = self.action_dist
        if isinstance(distribution, DiagGaussianDistribution):
            return distribution.proba_distribution(parameters, self.log_std)
        if isinstance(distribution, CategoricalDistribution):
            distribution.distribution = NormalizedCategorical(parameters)
        elif isinstance(distribution, MultiCategoricalDistribution):
            components = parameters.split(list(self.spec_of_actions.sizes), dim=1)
            distribution.distribution = [NormalizedCategorical(component) for component in components]
        else:
            distribution.proba_distribution(action_logits=parameters)
        return distribution

    def derivation_terms(self, obs: th.Tensor, condition_values: th.Tensor) -> th.Tensor:
        """Return what :meth:`evaluate_derivation` needs, which stays the same while only W is moved.

        :param obs: ``(n, n_inputs)``
        :param condition_values: the values of B, ``(n, depth - 1)``
        """
        return self.module.derivation_terms(self._split_features(obs)[0], condition_values)

    def evaluate_derivation(self, terms: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor | None]:
        """Return log-probabilities and entropies.

        :param terms: from :meth:`derivation_terms`, ``(n, ...)``
        :param actions: ``(n,)`` or ``(n, ...)``
        """
        distribution = self._distribution_of(self.module.mix_derivation(terms))
        return distribution.log_prob(actions), distribution.entropy()

    def evaluate_condition_values(
        self, obs: th.Tensor, condition_values: th.Tensor, actions: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Return values and log-probabilities for conditions whose values are known.

        :param obs: ``(n, n_inputs)``
        :param condition_values: the values of B, ``(n, depth - 1)``
        :param actions: ``(n,)`` or ``(n, ...)``
        """
        features, critic_features = self._split_features(obs)
        return self._values(critic_features), self._distribution(features, condition_values).log_prob(actions)

    def output_gradients(
        self, obs: th.Tensor, condition_values: th.Tensor, actions: th.Tensor, advantages: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Return where each state's policy gradient would move the outputs of the controllers.

        :param obs: ``(n, n_inputs)``
        :param condition_values: the values of B, ``(n, depth - 1)``
        :param actions: ``(n,)`` or ``(n, ...)``
        :param advantages: ``(n,)``
        :return: X, ``(n, n_inputs)``; the gradient of ``advantage * log_prob`` by the outputs of the controllers in
            use, ``(n_in_use, n, n_outputs)``; the weights of these controllers, ``(n, n_in_use)``
        """
        with th.no_grad():
            features, _ = self._split_features(obs)
            weights = self.module.mixture_weights(condition_values)
            outputs = self.module.controller_outputs(features)
        outputs.requires_grad_(True)
        log_prob = self._distribution_of(self.module.mix_outputs(outputs, weights)).log_prob(actions)
        (gradients,) = th.autograd.grad((advantages * log_prob).sum(), outputs)
        return features, gradients.permute(0, 2, 1), weights

    def crisp_disagreement(self, obs: th.Tensor, condition_values: th.Tensor) -> float:
        """Return the share of steps on which soft and crisp program would not choose the same.

        :param obs: ``(n, n_inputs)``
        :param condition_values: the values of B, ``(n, depth - 1)``
        """
        return self.module.crisp_disagreement(self._split_features(obs)[0], condition_values)

    def condition_values(self, obs: th.Tensor, states: tuple[th.Tensor, ...] | None = None) -> th.Tensor:
        """Return the value of B of every condition, ``(n, depth - 1)``.

        :param obs: ``(n, n_inputs)``; for recurrent conditions the steps of each sequence one after the other
        :param states: of recurrent conditions at the start of the sequences
        """
        features, _ = self._split_features(obs)
        return self._condition_values(
            features, states or self.module.initial_state(1), features.new_zeros(len(features))
        )[0]

    def _condition_values(
        self, features: th.Tensor, states: tuple[th.Tensor, ...], episode_starts: th.Tensor
    ) -> tuple[th.Tensor, State]:
        """Return the values of B and the new states; affine conditions have none."""
        return self.module.conditions(features, cast(State, states))

    def _values(self, features: th.Tensor) -> th.Tensor:
        return self.value_net(self.mlp_extractor.forward_critic(features))

    def _split_features(self, obs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return the features of the program and of the critic."""
        features = self.extract_features(obs)
        return features if isinstance(features, tuple) else (features, features)
