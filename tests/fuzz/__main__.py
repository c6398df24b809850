"""Run a fuzzer: ``python -m tests.fuzz programs --cases 10000 --seed 0``."""

import argparse
import time

from tests.fuzz import configurations, exports, kills, models, programs
from tests.fuzz.runner import Fuzzer, run

FUZZERS = {
    "programs": Fuzzer(programs.case, cases=10_000, short=400),
    "exports": Fuzzer(exports.case, cases=1_000, short=100),
    "configurations": Fuzzer(configurations.case, cases=1_000, short=100),
    "models": Fuzzer(models.case, cases=10_000, short=200),
    "kills": Fuzzer(kills.case, cases=40, short=1),
}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("fuzzer", choices=FUZZERS)
    parser.add_argument("--cases", type=int, help="how many; by default those of a long run")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    fuzzer = FUZZERS[arguments.fuzzer]
    start = time.perf_counter()
    outcomes = run(fuzzer, arguments.cases or fuzzer.cases, arguments.seed)
    for outcome, count in sorted(outcomes.items()):
        print(f"{count:7} {outcome}")
    print(f"{outcomes.total():7} cases of seed {arguments.seed} in {time.perf_counter() - start:.0f} s, no fault")


if __name__ == "__main__":
    main()
