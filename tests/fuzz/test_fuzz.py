import pytest

from tests.fuzz.__main__ import FUZZERS
from tests.fuzz.runner import Fuzzer, run


@pytest.mark.parametrize("name", FUZZERS)
def test_short_run_finds_no_fault(name):
    outcomes = run(FUZZERS[name], FUZZERS[name].short, seed=1)
    assert outcomes.total() == FUZZERS[name].short


def test_case_that_fails_is_named():
    def case(rng, folder):
        return f"{1 / int(rng.integers(3))}"

    with pytest.raises(AssertionError, match=r"case \d+ of seed 5: ZeroDivisionError"):
        run(Fuzzer(case, 50, 50), 50, seed=5)
