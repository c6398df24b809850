"""Conditions of several sums, all of which must not be below 0: each is fitted where the others hold."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sb3_progpolicy.imitation.conditions import fit_condition, fit_priced_condition, refit_condition
from sb3_progpolicy.imitation.decision_list import Floats

FEWEST = 20  # states that a sum is fitted to


def holds(inputs: Floats, sums: Floats) -> NDArray[np.bool_]:
    """Return where none of some sums is below 0, ``(n,)``.

    :param inputs: ``(n, width)``
    :param sums: ``(n_sums, width)``
    """
    return np.asarray((inputs @ sums.T >= 0).all(axis=1))


class ConditionFitter:
    """Fits conditions to gains, with a price on each input and on each further sum.

    :param price: of an input, in the unit of the gains
    :param worth: price of a further sum, beyond that of its inputs
    :param most: number of sums at most
    """

    def __init__(self, price: float, worth: float, most: int) -> None:
        self.price, self.worth, self.most = price, worth, most

    def value(self, inputs: Floats, gains: Floats, sums: Floats) -> float:
        """Return the sum of the gains where a condition holds, less its price."""
        return float(gains[holds(inputs, sums)].sum()) - self.price_of(sums)

    def price_of(self, sums: Floats) -> float:
        """Return what the inputs of a condition and its further sums cost.

        :param sums: ``(n_sums, width)``
        """
        return self.price * float(np.count_nonzero(sums[:, :-1])) + self.worth * (len(sums) - 1)

    def first(self, inputs: Floats, gains: Floats, start: Floats) -> tuple[Floats | None, float]:
        """Return a condition that begins with one known sum, and its value.

        :param inputs: ``(n, width)``
        :param gains: ``(n,)``
        :param start: the known sum, ``(width,)``
        :return: ``(n_sums, width)``, ``None`` if there is hardly anything to gain
        """
        fewer, value = fit_priced_condition(inputs, gains, start, self.price)
        if fewer is None:
            return None, 0.0
        return self._extended(inputs, gains, fewer[None], value)

    def again(self, inputs: Floats, gains: Floats, start: Floats, same_inputs: bool) -> Floats:
        """Return a condition at least as good as a known one.

        :param inputs: ``(n, width)``
        :param gains: ``(n,)``
        :param start: the known condition, ``(n_sums, width)``
        :param same_inputs: whether the known sums keep their inputs, which is far quicker
        """
        sums, value = self._refitted(inputs, gains, start, same_inputs)
        sums, value = self._extended(inputs, gains, sums, value)
        return self._shortened(inputs, gains, sums, value)

    def _refitted(self, inputs: Floats, gains: Floats, sums: Floats, same_inputs: bool) -> tuple[Floats, float]:
        """Fit each sum again where the others hold."""
        value = self.value(inputs, gains, sums)
        for index in range(len(sums)):
            here = holds(inputs, np.delete(sums, index, axis=0))
            if here.sum() < FEWEST:
                continue
            fitted: Floats | None
            if same_inputs:
                fitted, _ = refit_condition(inputs[here], gains[here], sums[index])
            else:
                fitted, _ = fit_priced_condition(inputs[here], gains[here], sums[index], self.price)
            if fitted is None:
                continue
            changed = sums.copy()
            changed[index] = fitted
            reached = self.value(inputs, gains, changed)
            if reached > value:
                sums, value = changed, reached
        return sums, value

    def _extended(self, inputs: Floats, gains: Floats, sums: Floats, value: float) -> tuple[Floats, float]:
        """Add sums as long as they are worth it."""
        while len(sums) < self.most:
            here = holds(inputs, sums)
            lost = -np.minimum(gains[here], 0).sum()
            if here.sum() < FEWEST or lost < self.worth + self.price:
                break
            start, _ = fit_condition(inputs[here], gains[here], ridges=(1e-3,), cautions=(1.0,))
            if start is None:
                break
            further, _ = fit_priced_condition(inputs[here], gains[here], start, self.price)
            if further is None:
                break
            more, reached = self._refitted(inputs, gains, np.vstack([sums, further]), same_inputs=True)
            if reached <= value:
                break
            sums, value = more, reached
        return sums, value

    def _shortened(self, inputs: Floats, gains: Floats, sums: Floats, value: float) -> Floats:
        """Leave out sums that are not worth it."""
        while len(sums) > 1:
            fewer = [np.delete(sums, index, axis=0) for index in range(len(sums))]
            values = [self.value(inputs, gains, one) for one in fewer]
            best = int(np.argmax(values))
            if values[best] < value:
                break
            sums, value = fewer[best], values[best]
        return sums
