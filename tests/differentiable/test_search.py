"""W, and the complete programs of a derivation graph."""

import math

import pytest
import torch as th

from sb3_progpolicy.differentiable.search import DerivationSearch


def test_choices_start_at_even_odds():
    search = DerivationSearch(5)
    assert search.probabilities().tolist() == [1 / 2, 1 / 4, 1 / 8, 1 / 16, 1 / 16]
    assert search.at_least().tolist() == [1 / 2, 1 / 4, 1 / 8, 1 / 16]
    assert search.entropy().item() == pytest.approx(4 * math.log(2))
    assert search.expected_conditions().item() == pytest.approx(1 / 4 + 2 / 8 + 3 / 16 + 4 / 16)


@pytest.mark.parametrize("depth", [1, 2, 6])
def test_probabilities_are_products_of_choices(depth):
    th.manual_seed(depth)
    search = DerivationSearch(depth)
    with th.no_grad():
        search.logits.normal_(std=2)
    choices = search.logits.softmax(-1)
    expected = [
        math.prod([choices[k, 1].item() for k in range(n)] + ([choices[n, 0].item()] if n < depth - 1 else []))
        for n in range(depth)
    ]
    assert search.probabilities().tolist() == pytest.approx(expected, abs=1e-6)
    assert search.probabilities().sum().item() == pytest.approx(1)
    assert search.expected_conditions().item() == pytest.approx(sum(n * p for n, p in enumerate(expected)), abs=1e-5)
    assert search.most_likely() == max(range(depth), key=expected.__getitem__)


@pytest.mark.parametrize("n_conditions", [0, 1, 3])
def test_selection_leaves_one_program_and_no_gradient(n_conditions):
    search = DerivationSearch(4)
    assert search.searching
    search.select(n_conditions)
    assert not search.searching
    assert search.most_likely() == n_conditions
    assert search.probabilities().tolist() == [float(n == n_conditions) for n in range(4)]
    assert search.entropy().item() == 0
    assert not search.probabilities().requires_grad


def test_selection_is_part_of_the_state():
    search, other = DerivationSearch(3), DerivationSearch(3)
    search.select(2)
    other.load_state_dict(search.state_dict())
    assert other.most_likely() == 2
    assert not other.searching


def test_descending_the_price_on_length_shortens_the_program():
    search = DerivationSearch(4)
    optimizer = th.optim.Adam(search.parameters(), lr=0.1)
    for _ in range(100):
        optimizer.zero_grad()
        search.expected_conditions().backward()
        optimizer.step()
    assert search.probabilities()[0] > 0.99
