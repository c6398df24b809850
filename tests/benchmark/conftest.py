"""The databases that a store is tested with."""

import os

import pytest


def store_url(kind, folder):
    """SQLite always, PostgreSQL where the address of one is given."""
    if kind == "sqlite":
        return str(folder / "results.db")
    url = os.environ.get("PROGPOLICY_TEST_POSTGRESQL")
    if url is None:
        pytest.skip("PROGPOLICY_TEST_POSTGRESQL has no address of a PostgreSQL database")
    import sqlalchemy as sa

    engine = sa.create_engine(url)
    with engine.begin() as connection:
        for table in ("rows", "members", "cells"):
            connection.execute(sa.text(f"DROP TABLE IF EXISTS {table}"))
    engine.dispose()
    return url


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request, tmp_path):
    return store_url(request.param, tmp_path)
