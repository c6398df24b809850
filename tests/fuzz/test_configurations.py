from collections import Counter

import numpy as np

from tests.fuzz.configurations import case


def test_damaged_configurations_are_taken_or_refused_in_one_line(tmp_path):
    outcomes = Counter()
    for number in range(100):
        folder = tmp_path / str(number)
        folder.mkdir()
        outcomes[case(np.random.default_rng([1, number]), folder)] += 1
    assert len(outcomes) > 5, outcomes
