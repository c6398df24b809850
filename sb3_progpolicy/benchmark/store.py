"""Where results are kept: a database that several runners may write to at once and any of them may die in."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError, SQLAlchemyError

from sb3_progpolicy.benchmark.cell import CellResult
from sb3_progpolicy.benchmark.suite import Suite, cap_of

#: Seconds without a sign of life after which a cell is taken from its runner.
STALE = 180.0
#: How often a cell is tried whose process dies before it is given up.
MAX_ATTEMPTS = 3
WAITING, RUNNING, DONE, FAILED = "waiting", "running", "done", "failed"

_SCHEMA = sa.MetaData()
_CELLS = sa.Table(
    "cells",
    _SCHEMA,
    sa.Column("key", sa.String(16), primary_key=True),
    sa.Column("method", sa.Text, nullable=False),
    sa.Column("env", sa.Text, nullable=False),
    sa.Column("seed", sa.BigInteger, nullable=False),
    sa.Column("cell", sa.Text, nullable=False),
    sa.Column("status", sa.String(10), nullable=False),
    sa.Column("owner", sa.Text),
    sa.Column("seen", sa.Float),
    sa.Column("attempts", sa.Integer, nullable=False),
    sa.Column("error", sa.Text),
    sa.Column("command", sa.Text),
    # What comes of the cell, as JSON: all fields of CellResult but its rows.
    sa.Column("result", sa.Text),
)
#: Which cells a suite has now; those that it had with another configuration stay in ``cells``, out of its results.
_MEMBERS = sa.Table(
    "members",
    _SCHEMA,
    sa.Column("suite", sa.String(200), primary_key=True),
    sa.Column("position", sa.Integer, primary_key=True),
    sa.Column("key", sa.String(16), sa.ForeignKey("cells.key"), nullable=False),
)
_ROWS = sa.Table(
    "rows",
    _SCHEMA,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("key", sa.String(16), sa.ForeignKey("cells.key"), nullable=False),
    sa.Column("set", sa.String(10), nullable=False),
    sa.Column("relation", sa.String(20), nullable=False),
    sa.Column("variation", sa.String(500), nullable=False),
    sa.Column("semantics", sa.String(10), nullable=False),  # "" for a network: NULLs would count as different
    sa.Column("episodes", sa.Integer, nullable=False),
    sa.Column("success_rate", sa.Float, nullable=False),
    sa.Column("steps_mean", sa.Float, nullable=False),
    sa.Column("steps_std", sa.Float, nullable=False),
    sa.Column("optimal_steps_mean", sa.Float),
    sa.UniqueConstraint("key", "set", "variation", "semantics"),
)


class Store:
    """A database of cells and their results.

    :param url: of SQLAlchemy, or the path of an SQLite file
    :param create: whether it may be made if it does not exist
    :raises ValueError: if it cannot be opened, or there is none
    """

    def __init__(self, url: str, create: bool = True) -> None:
        if "://" not in url:
            url = f"sqlite:///{url}"
        try:
            self.engine = sa.create_engine(url)
            file = self.engine.url.database if self.engine.dialect.name == "sqlite" else None
            if not create and file and not os.path.isfile(file):
                raise ValueError(f"{file} does not exist; a store is an SQLite file or a database URL")
            if self.engine.dialect.name == "sqlite":
                sa.event.listen(self.engine, "connect", _prepare_sqlite)
                sa.event.listen(self.engine, "begin", lambda connection: connection.exec_driver_sql("BEGIN IMMEDIATE"))
            self._make_tables() if create else self._check_tables(url)
        except ModuleNotFoundError as error:
            raise ValueError(f"{url} needs {error.name}, which is not installed") from None
        except (SQLAlchemyError, OSError) as error:
            raise ValueError(f"{url} cannot be opened as a store: {_first_line(error)}") from None
        #: This runner, as others see it.
        self.owner = f"{socket.gethostname()}:{os.getpid()}:{os.urandom(4).hex()}"

    def _make_tables(self) -> None:
        for attempt in range(3):  # two runners may do so at once
            try:
                _SCHEMA.create_all(self.engine)
                return
            except SQLAlchemyError:
                if attempt == 2:
                    raise
                time.sleep(0.2)

    def _check_tables(self, url: str) -> None:
        missing = set(_SCHEMA.tables) - set(sa.inspect(self.engine).get_table_names())
        if missing:
            raise ValueError(f"{url} is not a store: it has no table {', '.join(sorted(missing))}")

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()

    def add(self, suite: Suite, commands: Sequence[str], keep_members: bool = False) -> None:
        """Make a suite's cells those that it has now; what is known of them stays.

        :param suite: whose cells they are
        :param commands: that reproduce them, one each
        :param keep_members: leave a suite that the store has with the cells that it has
        """
        for cell, command in zip(suite.cells, commands, strict=True):
            values = {
                "key": cell.key,
                "method": cell.method,
                "env": cell.config.env,
                "seed": cell.config.seed,
                "cell": json.dumps(cell.to_json()),
                "status": WAITING,
                "attempts": 0,
                "command": command,
            }
            try:
                with self.engine.begin() as connection:
                    if connection.execute(sa.select(_CELLS.c.key).where(_CELLS.c.key == cell.key)).first() is None:
                        connection.execute(sa.insert(_CELLS).values(values))
            except IntegrityError:
                pass  # another runner was quicker
        members = [
            {"suite": suite.name, "position": position, "key": cell.key} for position, cell in enumerate(suite.cells)
        ]
        with self.engine.begin() as connection:
            known = connection.execute(sa.select(_MEMBERS).where(_MEMBERS.c.suite == suite.name)).mappings().all()
            if known and keep_members:
                return
            if sorted(map(_as_tuple, known)) != sorted(map(_as_tuple, members)):
                connection.execute(sa.delete(_MEMBERS).where(_MEMBERS.c.suite == suite.name))
                connection.execute(sa.insert(_MEMBERS), members)

    def retry_failed(self, keys: Sequence[str]) -> None:
        """Let cells that have failed be tried again.

        :param keys: of the cells
        """
        with self.engine.begin() as connection:
            connection.execute(
                sa.update(_CELLS)
                .where(_CELLS.c.key.in_(keys), _CELLS.c.status == FAILED)
                .values(status=WAITING, attempts=0, error=None)
            )

    def claim(self, keys: Sequence[str]) -> str | None:
        """Take the first cell that nobody works on, so that no other runner does.

        A cell whose runner has died is taken over: at once if it ran on this machine, else after :data:`STALE` seconds.

        :param keys: of the cells wanted, in this order
        :return: its key; ``None`` if there is none
        """
        now = time.time()
        with self.engine.connect() as connection:
            query = sa.select(_CELLS).where(_CELLS.c.key.in_(keys), _CELLS.c.status.in_((WAITING, RUNNING)))
            found = {row["key"]: row for row in connection.execute(query).mappings()}
        for key in keys:
            row = found.get(key)
            if row is None or (row["status"] == RUNNING and not _is_abandoned(row["owner"], row["seen"], now)):
                continue
            if row["status"] == RUNNING and row["attempts"] >= MAX_ATTEMPTS:
                self.fail(key, f"its process died {row['attempts']} times", row["owner"])
                continue
            with self.engine.begin() as connection:
                taken = connection.execute(
                    sa.update(_CELLS)
                    .where(
                        _CELLS.c.key == key,
                        _CELLS.c.status == row["status"],
                        _CELLS.c.owner.is_(None) if row["owner"] is None else _CELLS.c.owner == row["owner"],
                        _CELLS.c.attempts == row["attempts"],
                    )
                    .values(status=RUNNING, owner=self.owner, seen=now, attempts=row["attempts"] + 1)
                )
            if taken.rowcount == 1:
                return key
        return None

    def show_life(self) -> None:
        """Tell other runners that this one still works on its cells."""
        with self.engine.begin() as connection:
            connection.execute(
                sa.update(_CELLS)
                .where(_CELLS.c.owner == self.owner, _CELLS.c.status == RUNNING)
                .values(seen=time.time())
            )

    def finish(self, key: str, result: CellResult) -> bool:
        """Keep what came of a cell, all of it or, if anything goes wrong on the way, nothing.

        :param key: of the cell
        :param result: of it
        :return: whether it was kept; ``False`` if another runner has finished the same cell before
        """
        described = {name: value for name, value in vars(result).items() if name != "rows"}
        rows = [
            {
                **row,
                "key": key,
                "variation": json.dumps(row["variation"], sort_keys=True),
                "semantics": row["semantics"] or "",
            }
            for row in result.rows
        ]
        with self.engine.begin() as connection:
            marked = connection.execute(
                sa.update(_CELLS)
                .where(_CELLS.c.key == key, _CELLS.c.status != DONE)
                .values(status=DONE, owner=None, error=None, result=json.dumps(described))
            )
            if marked.rowcount == 1:
                connection.execute(sa.insert(_ROWS), rows)
        return marked.rowcount == 1

    def fail(self, key: str, error: str, owner: str | None = None) -> None:
        """Note that a cell cannot be done.

        :param key: of the cell
        :param error: why
        :param owner: the runner that had it; this one by default
        """
        self._give_up(key, owner, status=FAILED, error=error[:2000])

    def release(self, key: str) -> None:
        """Give a cell back that was interrupted, so that any runner can go on with it.

        :param key: of the cell
        """
        self._give_up(key, None, status=WAITING, attempts=0)

    def _give_up(self, key: str, owner: str | None, **values: Any) -> None:
        with self.engine.begin() as connection:
            connection.execute(
                sa.update(_CELLS)
                .where(_CELLS.c.key == key, _CELLS.c.status == RUNNING, _CELLS.c.owner == (owner or self.owner))
                .values(owner=None, **values)
            )

    def statuses(self, keys: Sequence[str]) -> dict[str, str]:
        """Return where cells stand.

        :param keys: of the cells
        """
        with self.engine.connect() as connection:
            query = sa.select(_CELLS.c.key, _CELLS.c.status).where(_CELLS.c.key.in_(keys))
            return {row.key: row.status for row in connection.execute(query)}

    def n_outside(self) -> int:
        """Return how many cells are of no suite here, so that no table shows them."""
        with self.engine.connect() as connection:
            members = sa.select(_MEMBERS.c.key)
            query = sa.select(sa.func.count()).select_from(_CELLS).where(_CELLS.c.key.not_in(members))
            return int(connection.execute(query).scalar_one())

    def errors(self, keys: Sequence[str]) -> dict[str, str]:
        """Return why cells have failed.

        :param keys: of the cells
        """
        with self.engine.connect() as connection:
            query = sa.select(_CELLS.c.key, _CELLS.c.error).where(_CELLS.c.key.in_(keys), _CELLS.c.status == FAILED)
            return {row.key: row.error for row in connection.execute(query)}

    def suites(self) -> list[str]:
        """Return the names of the suites."""
        with self.engine.connect() as connection:
            return list(connection.execute(sa.select(_MEMBERS.c.suite).distinct().order_by(_MEMBERS.c.suite)).scalars())

    def checked_suite(self, suite: str | None) -> str:
        """Return the name of a suite that the store has.

        :param suite: its name; may be left out where there is only one
        :raises ValueError: if there is no such suite
        """
        known = self.suites()
        if suite is None and len(known) == 1:
            return known[0]
        if suite not in known:
            listed = ", ".join(known) or "none"
            raise ValueError(f"--suite {suite!r} is not accepted; the store has: {listed}")
        return suite

    def cells(self, suite: str | None = None) -> list[dict[str, Any]]:
        """Return the cells of a suite: what they are, where they stand, and what came of those that are done.

        :param suite: its name; may be left out where there is only one
        :raises ValueError: if there is no such suite
        """
        query = (
            sa.select(_CELLS)
            .join(_MEMBERS, _MEMBERS.c.key == _CELLS.c.key)
            .where(_MEMBERS.c.suite == self.checked_suite(suite))
            .order_by(_MEMBERS.c.position)
        )
        with self.engine.connect() as connection:
            found = [dict(row) for row in connection.execute(query).mappings()]
        for row in found:
            row["cell"] = json.loads(row["cell"])
            row["result"] = None if row["result"] is None else json.loads(row["result"])
        return found

    def rows(self, suite: str | None = None) -> list[dict[str, Any]]:
        """Return the results of a suite, one row for each variation of each cell that is done.

        :param suite: its name; may be left out where there is only one
        :raises ValueError: if there is no such suite
        """
        by_cell = self.raw_rows(suite)
        return [_exported(cell, row) for cell in self.cells(suite) for row in by_cell.get(cell["key"], ())]

    def raw_rows(self, suite: str | None = None) -> dict[str, list[dict[str, Any]]]:
        """Return the rows of a suite's cells as :class:`CellResult` has them, by key of the cell.

        :param suite: its name; may be left out where there is only one
        :raises ValueError: if there is no such suite
        """
        query = (
            sa.select(_ROWS)
            .join(_MEMBERS, _MEMBERS.c.key == _ROWS.c.key)
            .where(_MEMBERS.c.suite == self.checked_suite(suite))
            .order_by(_ROWS.c.id)
        )
        by_cell: dict[str, list[dict[str, Any]]] = {}
        with self.engine.connect() as connection:
            for found in connection.execute(query).mappings():
                row = {name: value for name, value in found.items() if name not in ("id", "key")}
                row |= {"variation": json.loads(row["variation"]), "semantics": row["semantics"] or None}
                by_cell.setdefault(found["key"], []).append(row)
        return by_cell


def _exported(cell: dict[str, Any], row: dict[str, Any]) -> dict[str, Any]:
    result = cell["result"]
    return {
        "method": cell["method"],
        "env": cell["env"],
        "seed": cell["seed"],
        **row,
        "cap": cap_of(cell["cell"]),
        **{name: result[name] for name in ("timesteps", "capped", "processor_seconds", "wall_seconds", "commit")},
        "versions": " ".join(f"{name}={version}" for name, version in result["versions"].items()),
        "config": cell["key"],
        "command": cell["command"],
    }


def _as_tuple(member: Any) -> tuple[str, int, str]:
    return member["suite"], member["position"], member["key"]


def _is_abandoned(owner: str | None, seen: float | None, now: float) -> bool:
    """Whether a runner has died, as far as can be known from here."""
    if owner is None or seen is None or now - seen > STALE:
        return True
    host, pid, _ = owner.rsplit(":", 2)
    if host != socket.gethostname() or int(pid) == os.getpid():
        return False
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return True
    except OSError:
        return False
    return False


def _prepare_sqlite(connection: Any, _: Any) -> None:
    connection.isolation_level = None  # SQLAlchemy begins transactions, the driver does not
    connection.execute("PRAGMA busy_timeout = 60000")
    connection.execute("PRAGMA foreign_keys = ON")


@contextmanager
def open_store(url: str, create: bool = True) -> Iterator[Store]:
    """Open a store and close it in the end.

    :param url: see :class:`Store`
    :param create: see :class:`Store`
    """
    store = Store(url, create)
    try:
        yield store
    finally:
        store.close()


def _first_line(error: BaseException) -> str:
    return str(error).strip().partition("\n")[0] or type(error).__name__
