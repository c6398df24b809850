"""Run the tests of Stable-Baselines3 and sb3-contrib with our algorithms and policies in place of theirs.

    python -m tests.sb3_suites [--variant NAME ...] [--source FOLDER] [--output FILE]

Prints a table: a line per variant, a column per difference on purpose. What fails for no such reason is listed below it
and makes the exit status 1. The suites come from the source distributions of the installed versions, which pip
downloads into a temporary folder, or which are in ``--source``. They need pandas, too.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

from tests.sb3_suites.differences import DIFFERENCES, reason
from tests.sb3_suites.sources import download, unpack
from tests.sb3_suites.variants import VARIANTS

ROOT = Path(__file__).parents[2]
Result = tuple[str, str, str]


def run(name: str, suite: Path, folder: Path) -> list[Result]:
    """Run one variant in a process of its own and return ``(test, outcome, message)``."""
    results = folder / "results.json"
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    with (folder / "log").open("w") as log:
        command = [sys.executable, "-m", "tests.sb3_suites.run_variant", name, str(suite), str(results)]
        subprocess.run(command, cwd=folder, env={**os.environ, "PYTHONPATH": path}, stdout=log, stderr=log, check=True)
    return [(test, outcome, message) for test, outcome, message in json.loads(results.read_text())]


def row(name: str, results: list[Result]) -> tuple[str, list[str]]:
    """Return a variant's line of the table, and the failures that no difference explains."""
    outcomes = Counter(outcome for _, outcome, _ in results)
    failed = [(test, message, reason(test, message)) for test, outcome, message in results if outcome == "failed"]
    reasons = Counter(why for _, _, why in failed)
    unexplained = [f"{name}: {test}: {message.splitlines()[0]:.200}" for test, message, why in failed if why is None]
    counts = [len(results) - outcomes["skipped"], outcomes["passed"], *(reasons[why] for why in DIFFERENCES)]
    cells = [name, *(str(count or "") for count in counts), str(len(unexplained))]
    return f"| {' | '.join(cells)} |", unexplained


def main() -> int:
    """Run the variants and print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.sb3_suites", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--variant", nargs="+", choices=VARIANTS, default=list(VARIANTS), help="by default all")
    parser.add_argument("--source", type=Path, help="folder that holds the source distributions")
    parser.add_argument("--output", type=Path, help="file to write the table to as well")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        if options.source is None:
            download(folder)
        suites = {
            package: unpack(package, options.source or folder, folder)
            for package in ("stable_baselines3", "sb3_contrib")
        }
        head = ["Variant", "run", "passed", *DIFFERENCES, "unexplained"]
        lines = [f"| {' | '.join(head)} |", f"|---|{'---:|' * (len(head) - 1)}"]
        unexplained: list[str] = []
        for line in lines:
            print(line)
        for name in options.variant:
            line, failures = row(name, run(name, suites[VARIANTS[name].package], folder))
            print(line, flush=True)
            lines.append(line)
            unexplained += failures
    if unexplained:
        print("", *unexplained, sep="\n")
    if options.output is not None:
        options.output.write_text("\n".join(lines) + "\n")
    return int(bool(unexplained))


if __name__ == "__main__":
    sys.exit(main())
