"""Decision lists fitted to labelled states: two ways to begin, alternating optimisation, and fewer inputs."""

from __future__ import annotations

import numpy as np

from sb3_progpolicy.imitation.conditions import fit_condition, fit_sparse_condition
from sb3_progpolicy.imitation.decision_list import Data, DecisionList, Floats, rest_losses
from sb3_progpolicy.imitation.losses import Loss, mean_loss

_NEIGHBOURS = 120
_FAILURES = 2  # draws of controllers in a row of which none helps
_COMMON = 0.05  # share of the states from which on a branch has to be exact
_LEAST = 1e-3  # gains below it do not matter


def grow(
    loss: Loss,
    data: Data,
    max_branches: int,
    rng: np.random.Generator,
    start: DecisionList | None = None,
    min_gain: float = 0.005,
    tries: int = 10,
) -> DecisionList:
    """Insert one branch after another where it pays most, until the loss falls by less than a share.

    :param loss: of the action space
    :param data: labelled states
    :param max_branches: number of controllers at most
    :param rng: source of the draws
    :param start: list to go on with; by default one controller
    :param min_gain: share of the loss that a branch has to take away
    :param tries: controllers tried for each branch
    """
    best = DecisionList(np.zeros((0, data.inputs.shape[1])), loss.fit(data)[None]) if start is None else start
    failures = 0
    while best.n_branches < max_branches and failures < _FAILURES:
        longer = _with_one_more(loss, best, data, rng, tries)
        if longer is not None:
            longer = alternate(loss, longer, data, sweeps=1)
        if longer is None or mean_loss(loss, longer, data) > mean_loss(loss, best, data) * (1 - min_gain):
            failures += 1
        else:
            best, failures = longer, 0
    return best


def _with_one_more(
    loss: Loss, program: DecisionList, data: Data, rng: np.random.Generator, tries: int
) -> DecisionList | None:
    """Return the list with the branch of the largest gain, at whatever position."""
    losses = loss.matrix(data, program.controllers)
    holds = data.inputs @ program.conditions.T >= 0
    rest = rest_losses(losses, holds)
    present = rest[0]

    def gain(controller: Floats) -> tuple[float, Floats]:
        own = loss.matrix(data, controller[None])[:, 0]
        return float((data.weights * np.maximum(present - own, 0)).sum()), own

    local = local_controllers(loss, data, present, rng, tries)
    candidates = []
    for controller in sorted(local, key=lambda one: -gain(one)[0])[:3]:
        for _ in range(3):
            better = gain(controller)[1] < present - _LEAST
            if better.sum() < 20:
                break
            controller = loss.fit(data.take(better), controller, iterations=3)
        candidates.append((*gain(controller), controller))
    candidates += [(*gain(controller), controller) for controller in program.controllers]
    candidates.sort(key=lambda candidate: -candidate[0])
    most, found = 1e-5 * len(data), None
    for _, own, controller in candidates[:4]:
        for position in range(program.n_branches):
            gains = data.weights * (rest[position] - own)
            here = ~holds[:, :position].any(axis=1) & (np.abs(gains) > _LEAST)
            if np.maximum(gains[here], 0).sum() <= most:
                continue
            condition, value = fit_condition(data.inputs[here], gains[here], ridges=(1e-3,))
            if condition is not None and value > most:
                most, found = value, (position, condition, controller)
    return None if found is None else program.insert(*found)


def local_controllers(loss: Loss, data: Data, present: Floats, rng: np.random.Generator, tries: int) -> list[Floats]:
    """Return controllers fitted to the neighbours, in inputs and labels, of states drawn by their loss.

    :param loss: of the action space
    :param data: labelled states
    :param present: loss of each state now, ``(n,)``
    :param rng: source of the draws
    :param tries: how many
    """
    chances = data.weights * (present + 1e-9)
    places = np.column_stack([data.inputs[:, :-1], 3.0 * data.targets])
    size = min(_NEIGHBOURS, len(data))
    controllers = []
    for state in rng.choice(len(data), tries, p=chances / chances.sum()):
        near = np.argpartition(((places - places[state]) ** 2).sum(axis=1), size - 1)[:size]
        part = data.take(near)
        controller = loss.fit(part, iterations=4, ridge=1e-2)
        for _ in range(2):  # neighbours may be of another branch: only the half that fits best is kept
            losses = loss.matrix(part, controller[None])[:, 0]
            controller = loss.fit(part.take(losses <= np.median(losses)), iterations=4, ridge=1e-2)
        controllers.append(controller)
    return controllers


def fit_planes(
    loss: Loss, data: Data, n_planes: int, max_branches: int, rng: np.random.Generator, iterations: int = 15
) -> DecisionList:
    """Fit some controllers, each to the states where it is the nearest, and put them in an order with conditions.

    :param loss: of the action space
    :param data: labelled states
    :param n_planes: number of controllers
    :param max_branches: of the list at most; a controller may stand in several branches
    :param rng: source of the draws
    :param iterations: of assigning and fitting
    """
    controllers: list[Floats] = []
    present = np.full(len(data), 4.0)
    for _ in range(n_planes):
        candidates = np.array(local_controllers(loss, data, present, rng, tries=4))
        losses = loss.matrix(data, candidates)
        best = int((data.weights[:, None] * np.minimum(present[:, None], losses)).sum(axis=0).argmin())
        controllers.append(candidates[best])
        present = np.minimum(present, losses[:, best])
    planes = np.array(controllers)
    for _ in range(iterations):
        nearest = loss.matrix(data, planes).argmin(axis=1)
        for index in range(n_planes):
            here = nearest == index
            if here.sum() > 10:
                planes[index] = loss.fit(data.take(here), planes[index], iterations=2)
    return alternate(loss, _ordered(loss, data, planes, max_branches), data, sweeps=5)


def _ordered(loss: Loss, data: Data, planes: Floats, max_branches: int) -> DecisionList:
    """Return a list of these controllers: again and again the condition that covers most states at the least cost."""
    losses = loss.matrix(data, planes)
    left = np.ones(len(data), dtype=bool)
    conditions: list[Floats] = []
    chosen: list[int] = []
    while len(chosen) < max_branches - 1 and left.sum() > 0.003 * len(data):
        inputs, here, weights = data.inputs[left], losses[left], data.weights[left]
        if np.average(here, axis=0, weights=weights).min() < 0.02:
            break
        least, most = here.min(axis=1), here.max(axis=1)
        value, found = 0.0, None
        for index in range(len(planes)):
            regret = here[:, index] - least
            covered = regret < 0.05
            if covered.sum() < 10:
                continue
            gains = weights * np.where(covered, np.minimum(most - here[:, index], 1.0), -8.0 * regret)
            condition, gained = fit_condition(inputs, gains, ridges=(1e-3,))
            if condition is not None and gained > value:
                value, found = gained, (index, condition)
        if found is None:
            break
        holds = inputs @ found[1] >= 0
        if holds.sum() < 5:
            break
        chosen.append(found[0])
        conditions.append(found[1])
        left[np.flatnonzero(left)[holds]] = False
    last = int(losses[left].mean(axis=0).argmin()) if left.any() else 0
    return DecisionList(np.array(conditions).reshape(-1, data.inputs.shape[1]), planes[[*chosen, last]])


def alternate(loss: Loss, program: DecisionList, data: Data, sweeps: int = 3, tolerance: float = 2e-3) -> DecisionList:
    """Fit every controller to the states it acts in, then every condition by its true gain, given all others.

    Each step is taken only if it makes the loss smaller (Carreira-Perpinan and Tavallali 2018, for lists).

    :param loss: of the action space
    :param program: to begin with
    :param data: labelled states
    :param sweeps: over the whole list at most
    :param tolerance: stop when a sweep takes away a smaller share of the loss
    """
    conditions, controllers = program.conditions.copy(), program.controllers.copy()
    before = np.inf
    for _ in range(sweeps):
        branches = DecisionList(conditions, controllers).branches(data.inputs)
        for index in range(len(controllers)):
            here = branches == index
            if here.sum() <= 3:
                continue
            part = data.take(here)
            fitted = loss.fit(part, controllers[index], iterations=3)
            old, new = part.weights @ loss.matrix(part, np.array([controllers[index], fitted]))
            if new < old:
                controllers[index] = fitted
        losses = loss.matrix(data, controllers)
        holds = data.inputs @ conditions.T >= 0
        rest = losses[:, -1]
        for index in reversed(range(len(conditions))):
            gains = data.weights * (rest - losses[:, index])
            here = ~holds[:, :index].any(axis=1) & (np.abs(gains) > 1e-6)
            if here.sum() > 10:
                condition, value = fit_condition(data.inputs[here], gains[here], conditions[index])
                if condition is not None and value > gains[here & holds[:, index]].sum() + 1e-9:
                    conditions[index] = condition
            holds[:, index] = data.inputs @ conditions[index] >= 0
            rest = np.where(holds[:, index], losses[:, index], rest)
        after = float(np.average(rest, weights=data.weights))
        if before - after < tolerance * before:
            break
        before = after
    return drop_branches(loss, DecisionList(conditions, controllers), data)


def drop_branches(loss: Loss, program: DecisionList, data: Data, price: float = 0.0) -> DecisionList:
    """Leave out the branches that the mean loss grows by at most ``price`` without, one after another."""
    present = mean_loss(loss, program, data)
    while program.n_branches > 1:
        fewer = [program.without(index) for index in range(program.n_branches)]
        losses = [mean_loss(loss, candidate, data) for candidate in fewer]
        best = int(np.argmin(losses))
        if losses[best] - present > price:
            break
        program, present = fewer[best], min(present, losses[best])
    return program


def sparsify(
    loss: Loss, program: DecisionList, data: Data, tolerance: float, always_few: bool = False, sweeps: int = 2
) -> DecisionList:
    """Return the list with the smallest support of each condition and output within a tolerance of the mean loss.

    :param loss: of the action space
    :param program: to begin with
    :param data: labelled states
    :param tolerance: by which the loss of an output may grow in its branch; a condition may cost 0.3 of that
    :param always_few: whether few inputs matter more than the tolerance
    :param sweeps: over the list
    """
    conditions, controllers = program.conditions.copy(), program.controllers.copy()
    n = len(data)
    for _ in range(sweeps):
        branches = DecisionList(conditions, controllers).branches(data.inputs)
        for index in range(len(controllers)):
            here = branches == index
            if here.sum() > 40:
                # A branch of few states may be less exact.
                allowed = tolerance * max(1.0, _COMMON * n / here.sum())
                controllers[index] = loss.fit_sparse(data.take(here), controllers[index], allowed, always_few)
        losses = loss.matrix(data, controllers)
        holds = data.inputs @ conditions.T >= 0
        rest = losses[:, -1]
        for index in reversed(range(len(conditions))):
            gains = data.weights * (rest - losses[:, index])
            here = ~holds[:, :index].any(axis=1) & (np.abs(gains) > _LEAST)
            if here.sum() > 20:
                allowed = 0.3 * tolerance * data.weights.sum()
                conditions[index] = fit_sparse_condition(
                    data.inputs[here], gains[here], conditions[index], allowed, always_few
                )
            holds[:, index] = data.inputs @ conditions[index] >= 0
            rest = np.where(holds[:, index], losses[:, index], rest)
    return drop_branches(loss, DecisionList(conditions, controllers), data, price=0.1 * tolerance)
