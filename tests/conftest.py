"""Tests that need PyBullet, of which there are no wheels for Python 3.12 and later, are skipped without it."""

from collections.abc import Generator

import pytest


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, None, None]:
    try:
        return (yield)
    except ModuleNotFoundError as error:
        if error.name in ("pybullet", "panda_gym"):
            pytest.skip(f"{error.name} is not installed")
        raise
