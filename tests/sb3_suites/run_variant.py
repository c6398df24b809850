"""Run a suite with an algorithm replaced: ``python -m tests.sb3_suites.run_variant VARIANT SUITE RESULTS``.

The algorithm is replaced in its package before a test module imports it from there, so that every test that names it
gets the other one. Tests that do not use it are left out. RESULTS becomes a JSON list of ``[test, outcome, message]``.
"""

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import CodeType
from typing import Any

import pytest
from stable_baselines3.common.base_class import BaseAlgorithm

from tests.sb3_suites.variants import VARIANTS, Variant


def classes_in(value: Any) -> Iterator[type[BaseAlgorithm]]:
    """Yield the algorithms in a parameter of a test."""
    if isinstance(value, type) and issubclass(value, BaseAlgorithm):
        yield value
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from classes_in(item)


def names_in(code: CodeType) -> Iterator[str]:
    """Yield the global names that a function and the functions in it use."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from names_in(constant)


class Substitution:
    """A plugin that keeps the tests of one algorithm and notes what became of them."""

    def __init__(self, variant: Variant) -> None:
        self.variant = variant
        self.results: list[tuple[str, str, str]] = []

    def concerns(self, item: pytest.Function) -> bool:
        """Return whether a test is one of the algorithm's."""
        parameters = list(item.callspec.params.values()) if hasattr(item, "callspec") else []
        algorithms = list(classes_in(parameters))
        if algorithms:
            return self.variant.by in algorithms
        if self.variant.replaced.lower() in [value for value in parameters if isinstance(value, str)]:
            return True
        return self.variant.replaced in names_in(item.function.__code__)

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = [item for item in items if isinstance(item, pytest.Function) and self.concerns(item)]

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call" or report.outcome != "passed":
            crash = getattr(report.longrepr, "reprcrash", None)
            message = crash.message if crash is not None else str(report.longrepr or "")
            self.results.append((report.nodeid.rpartition("/")[2], report.outcome, message))


def main() -> None:
    name, suite, results = sys.argv[1:]
    variant = VARIANTS[name]
    setattr(importlib.import_module(variant.package), variant.replaced, variant.by)
    plugin = Substitution(variant)
    modules = [str(path) for path in sorted(Path(suite).glob("test_*.py")) if variant.replaced in path.read_text()]
    options = ["-q", "--tb=short", "-p", "no:cacheprovider", "-m", "not slow and not expensive"]
    pytest.main([*options, *modules], plugins=[plugin])
    Path(results).write_text(json.dumps(plugin.results))


if __name__ == "__main__":
    main()
