"""The SQLite file of a catalogue: its tables, and access to them.

Several processes may use the file at once. Writers wait for each other, and readers only see finished changes
(write-ahead logging). If a process is killed, its unfinished changes are undone.
"""

import os
import sqlite3
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from jaxmark.errors import JaxmarkError

_APPLICATION = 0x6A786D63  # the number in the file's header that marks it as a catalogue, "jxmc"
_WAIT = 60.0  # largest number of seconds that a writer waits for another one
_PAUSE = 0.05  # seconds between attempts

# Each migration changes a file from one version to the next; files store their version. Never change a migration.
_MIGRATIONS = (
    """
    CREATE TABLE originals (
        id INTEGER PRIMARY KEY,
        content TEXT NOT NULL UNIQUE,  -- SHA-256 of the file
        path TEXT NOT NULL,
        bytes INTEGER NOT NULL,
        copy BLOB,  -- the file itself, where it was asked for
        thumbnail BLOB,  -- PNG
        added TEXT NOT NULL
    );
    CREATE TABLE shapes (  -- the meshes of an original's file
        id INTEGER PRIMARY KEY,
        original INTEGER NOT NULL REFERENCES originals ON DELETE CASCADE,
        name TEXT NOT NULL,
        geometry TEXT NOT NULL,  -- hash of the canonical geometry, as in records of version 2
        exact TEXT NOT NULL,  -- `geometry_hash`
        vertices INTEGER NOT NULL,
        faces INTEGER NOT NULL,
        described INTEGER NOT NULL,  -- version of the descriptors
        whole BLOB NOT NULL,
        parts BLOB NOT NULL,
        points BLOB NOT NULL,
        UNIQUE (original, name)
    );
    CREATE INDEX shapes_by_geometry ON shapes (geometry);
    CREATE INDEX shapes_by_exact ON shapes (exact);
    CREATE TABLE keys (
        commitment TEXT PRIMARY KEY,
        added TEXT NOT NULL
    );
    CREATE TABLE records (
        digest TEXT PRIMARY KEY,
        shape INTEGER NOT NULL REFERENCES shapes ON DELETE CASCADE,
        key TEXT NOT NULL REFERENCES keys,
        content TEXT NOT NULL,
        json TEXT NOT NULL,
        added TEXT NOT NULL
    );
    CREATE INDEX records_by_shape ON records (shape, key);
    CREATE TABLE copies (  -- what recipients were given
        id INTEGER PRIMARY KEY,
        shape INTEGER NOT NULL REFERENCES shapes ON DELETE CASCADE,
        key TEXT NOT NULL REFERENCES keys,
        recipient TEXT NOT NULL,
        record TEXT NOT NULL REFERENCES records ON DELETE CASCADE,
        file TEXT NOT NULL,  -- SHA-256 of the copy
        added TEXT NOT NULL,
        UNIQUE (shape, key, recipient)
    );
    CREATE TABLE verdicts (
        id INTEGER PRIMARY KEY,
        suspect TEXT NOT NULL,  -- SHA-256 of its file
        path TEXT NOT NULL,
        given TEXT NOT NULL,
        versions TEXT NOT NULL,  -- JSON
        result TEXT NOT NULL  -- JSON
    );
    CREATE INDEX verdicts_by_suspect ON verdicts (suspect);
    """,
    "ALTER TABLE shapes ADD COLUMN landmarks BLOB NOT NULL DEFAULT x''",
)
VERSION = len(_MIGRATIONS)


class Database:
    """A connection to a catalogue's file, for use by one thread at a time."""

    def __init__(self, path: str | os.PathLike[str], *, read_only: bool = False) -> None:
        """Open the file. One that does not exist is created by the first change, unless it is opened for reading only.

        Raises:
            JaxmarkError: if the file cannot be opened, is no catalogue, or has a later version.
        """
        self.path = Path(os.path.realpath(path))
        self.read_only = read_only
        if read_only and not self.path.is_file():
            raise JaxmarkError(f"There is no catalogue {path}; create one by `jaxmark catalogue add`.")
        if not self.path.parent.is_dir():
            raise JaxmarkError(f"The folder {self.path.parent} of the catalogue does not exist; create it first.")
        self._is_draft = not read_only and not self.path.exists()  # empty, in memory, until there is a file
        self._open()

    def close(self) -> None:
        """Close the connection; unfinished changes are undone."""
        with suppress(sqlite3.Error):
            self._connection.close()

    def rows(self, statement: str, *values: object) -> list[sqlite3.Row]:
        """Return the rows of a query.

        Raises:
            JaxmarkError: if the file is damaged, or another process locks it for a minute.
        """
        return list(self.each(statement, *values))

    def each(self, statement: str, *values: object) -> Iterator[sqlite3.Row]:
        """Yield the rows of a query one after the other, which saves memory for large results; see `rows`."""
        with self._clear_errors():
            # Unlike the cursor, this iterator is not closed with the generator, perhaps after the connection was.
            yield from iter(self._current().execute(statement, values).fetchone, None)

    def run(self, statement: str, *values: object) -> int:
        """Change rows, within `writing`, and return the number of changed rows; see `rows`."""
        with self._clear_errors():
            return self._current().execute(statement, values).rowcount

    def insert(self, table: str, values: Mapping[str, object]) -> bool:
        """Insert a row, within `writing`, unless it exists; returns whether it is new; see `rows`."""
        places = ", ".join("?" * len(values))
        statement = f"INSERT INTO {table} ({', '.join(values)}) VALUES ({places}) ON CONFLICT DO NOTHING"
        return self.run(statement, *values.values()) == 1

    def insert_original(self, file: Mapping[str, Any], shapes: Iterable[Mapping[str, Any]]) -> tuple[int, bool]:
        """Insert an original and its meshes, unless they exist; returns its number, and whether it is new."""
        new = self.insert("originals", file)
        (row,) = self.rows("SELECT id FROM originals WHERE content = ?", file["content"])
        for shape in shapes if new else ():
            self.insert("shapes", {"original": row["id"], **shape})
        return row["id"], new

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Run a block as a transaction: make all its changes or none, while other writers wait.

        Raises:
            JaxmarkError: if the catalogue is opened for reading only; see `rows`.
        """
        if self.read_only:
            raise JaxmarkError(f"The catalogue {self.path} was opened for reading only; open it without `read_only`.")
        self._current(create=True)
        with self._transaction("IMMEDIATE"):
            yield

    @contextmanager
    def _transaction(self, kind: str) -> Iterator[None]:
        with self._clear_errors():
            self._connection.execute(f"BEGIN {kind}")
        try:
            yield
            with self._clear_errors():
                self._connection.execute("COMMIT")
        except BaseException:
            with suppress(sqlite3.Error):
                self._connection.execute("ROLLBACK")
            raise

    def problems(self) -> list[str]:
        """Return the problems that SQLite's checks report for the file."""
        damages = [row[0] for row in self.rows("PRAGMA integrity_check(5)") if row[0] != "ok"]
        keys = self.rows("PRAGMA foreign_key_check")
        return damages + [f"a row of {row[0]} refers to a row that does not exist" for row in keys]

    def _current(self, *, create: bool = False) -> sqlite3.Connection:
        """Return the connection; to the file as soon as it exists, or is to be created."""
        if self._is_draft and (create or self.path.exists()):
            self.close()
            self._is_draft = False
            self._open()
        return self._connection

    def _open(self) -> None:
        with self._clear_errors():
            self._connection = self._connect()
            try:
                self._prepare()
            except BaseException:
                self._connection.close()
                raise

    def _connect(self) -> sqlite3.Connection:
        if self._is_draft:
            return self._connection_to(":memory:")
        if not self.read_only:
            return self._connection_to(str(self.path))
        # SQLite cannot create the index of the log in a folder that is not writable. In this case no process writes the
        # file, so that it can be opened as immutable.
        connection = self._connection_to(f"{self.path.as_uri()}?mode=ro")
        try:
            connection.execute("SELECT * FROM sqlite_master").fetchone()
            return connection
        except sqlite3.DatabaseError as error:
            connection.close()
            log = self.path.with_name(self.path.name + "-wal")
            if not isinstance(error, sqlite3.OperationalError) or log.exists():
                raise
            return self._connection_to(f"{self.path.as_uri()}?mode=ro&immutable=1")

    @staticmethod
    def _connection_to(name: str) -> sqlite3.Connection:
        connection = sqlite3.connect(
            name, timeout=_WAIT, isolation_level=None, uri=name.startswith("file:"), check_same_thread=False
        )
        connection.row_factory = sqlite3.Row
        connection.execute("PRAGMA foreign_keys = ON")
        connection.execute("PRAGMA trusted_schema = OFF")
        return connection

    def _prepare(self) -> None:
        """Check the file, and migrate it to the newest version."""
        version = self._version()
        if version == VERSION:
            return
        if self.read_only:
            raise JaxmarkError(
                f"{self.path} has the old version {version}; open it once for writing, which migrates it."
            )
        self._use_log()
        with self._transaction("EXCLUSIVE"):
            for migration in _MIGRATIONS[self._version() :]:  # another process may have migrated it meanwhile
                for statement in migration.split(";"):
                    self._connection.execute(statement)
            self._connection.execute(f"PRAGMA application_id = {_APPLICATION}")
            self._connection.execute(f"PRAGMA user_version = {VERSION}")

    def _version(self) -> int:
        """Return the version of the file, 0 if it is new; refuse later versions and files of other programs."""
        version, application, tables = (
            self._connection.execute(query).fetchone()[0]
            for query in ("PRAGMA user_version", "PRAGMA application_id", "SELECT count(*) FROM sqlite_master")
        )
        if tables and application != _APPLICATION:
            raise JaxmarkError(f"{self.path} is the database of another program, not a catalogue; give another file.")
        if version > VERSION:
            raise JaxmarkError(
                f"The catalogue {self.path} has the version {version}, but this jaxmark reads versions up to {VERSION};"
                " use a later jaxmark."
            )
        return version if tables else 0

    def _use_log(self) -> None:
        """Turn on write-ahead logging; retry while the file is locked, because SQLite does not wait in this case."""
        until = time.monotonic() + _WAIT
        while True:
            try:
                self._connection.execute("PRAGMA journal_mode = WAL")
                return
            except sqlite3.OperationalError:
                if time.monotonic() > until:
                    raise
                time.sleep(_PAUSE)

    @contextmanager
    def _clear_errors(self) -> Iterator[None]:
        """Convert exceptions of SQLite to `JaxmarkError`."""
        try:
            yield
        except UnicodeEncodeError as error:
            raise JaxmarkError(f"The name {error.object!a} is not text in UTF-8; rename the file.") from None
        except sqlite3.OperationalError as error:
            raise JaxmarkError(f"The catalogue {self.path} cannot be used: {error}.") from None
        except sqlite3.DatabaseError as error:
            raise JaxmarkError(
                f"{self.path} is no catalogue, or is damaged: {error}; use a backup, or import an export into a new"
                " catalogue."
            ) from None
