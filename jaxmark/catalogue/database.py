"""The SQLite file of a catalogue: its tables, and access to them.

Several processes may use it at once: writers wait for each other, and readers see only what was finished (write-ahead
logging). A process that is killed leaves nothing half done.
"""

import os
import sqlite3
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from jaxmark.errors import JaxmarkError

_APPLICATION = 0x6A786D63  # marks the file as a catalogue, "jxmc"
_WAIT = 60.0  # seconds that a writer waits for another one
_PAUSE = 0.05  # seconds

# Each brings a file from the version before to the next; files remember their version. Never change one.
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
    """A connection to a catalogue's file; to be used by one thread at a time."""

    def __init__(self, path: str | os.PathLike[str], *, read_only: bool = False) -> None:
        """Open the file, and make it if it is to be written and does not exist.

        Raises:
            JaxmarkError: if it cannot be opened, is no catalogue, or is of a later version.
        """
        self.path = Path(os.path.realpath(path))
        self.read_only = read_only
        if read_only and not self.path.is_file():
            raise JaxmarkError(f"There is no catalogue {path}; `jaxmark catalogue add` makes one.")
        if not self.path.parent.is_dir():
            raise JaxmarkError(f"The folder {self.path.parent} of the catalogue does not exist.")
        with self._clear_errors():
            self._connection = self._connect()
            try:
                self._prepare()
            except BaseException:
                self._connection.close()
                raise

    def close(self) -> None:
        """Close the connection; what was not finished is undone."""
        with suppress(sqlite3.Error):
            self._connection.close()

    def rows(self, statement: str, *values: object) -> list[sqlite3.Row]:
        """Return the rows that a query finds.

        Raises:
            JaxmarkError: if the file is damaged, or was busy for a minute.
        """
        return list(self.each(statement, *values))

    def each(self, statement: str, *values: object) -> Iterator[sqlite3.Row]:
        """Yield the rows that a query finds, one after the other, for large ones; see `rows`."""
        with self._clear_errors():
            yield from self._connection.execute(statement, values)

    def run(self, statement: str, *values: object) -> int:
        """Change rows, within `writing`, and return how many changed; see `rows`."""
        with self._clear_errors():
            return self._connection.execute(statement, values).rowcount

    def insert(self, table: str, values: Mapping[str, object]) -> bool:
        """Insert a row, within `writing`; returns whether it was not there; see `rows`."""
        places = ", ".join("?" * len(values))
        statement = f"INSERT INTO {table} ({', '.join(values)}) VALUES ({places}) ON CONFLICT DO NOTHING"
        return self.run(statement, *values.values()) == 1

    def insert_original(self, file: Mapping[str, Any], shapes: Iterable[Mapping[str, Any]]) -> tuple[int, bool]:
        """Insert an original and its meshes; returns its number, and whether it was not there."""
        new = self.insert("originals", file)
        (row,) = self.rows("SELECT id FROM originals WHERE content = ?", file["content"])
        for shape in shapes if new else ():
            self.insert("shapes", {"original": row["id"], **shape})
        return row["id"], new

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Make all changes of the block, or none; other writers wait.

        Raises:
            JaxmarkError: if the catalogue is opened for reading only; see `rows`.
        """
        if self.read_only:
            raise JaxmarkError(f"The catalogue {self.path} was opened for reading only.")
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
        """Return the damages that SQLite finds in the file."""
        found = [row[0] for row in self.rows("PRAGMA integrity_check(5)") if row[0] != "ok"]
        return found + [f"a row of {row[0]} refers to a missing one" for row in self.rows("PRAGMA foreign_key_check")]

    def _connect(self) -> sqlite3.Connection:
        if not self.read_only:
            return self._open(str(self.path))
        # A folder that cannot be written to has no room for the log's index; then nobody writes the file either.
        connection = self._open(f"{self.path.as_uri()}?mode=ro")
        try:
            connection.execute("SELECT * FROM sqlite_master").fetchone()
            return connection
        except sqlite3.DatabaseError as error:
            connection.close()
            log = self.path.with_name(self.path.name + "-wal")
            if not isinstance(error, sqlite3.OperationalError) or log.exists():
                raise
            return self._open(f"{self.path.as_uri()}?mode=ro&immutable=1")

    @staticmethod
    def _open(name: str) -> sqlite3.Connection:
        connection = sqlite3.connect(
            name, timeout=_WAIT, isolation_level=None, uri=name.startswith("file:"), check_same_thread=False
        )
        connection.row_factory = sqlite3.Row
        connection.execute("PRAGMA foreign_keys = ON")
        connection.execute("PRAGMA trusted_schema = OFF")
        return connection

    def _prepare(self) -> None:
        """Check the file, and bring it to the newest version."""
        version = self._version()
        if version == VERSION:
            return
        if self.read_only:
            raise JaxmarkError(f"{self.path} is of version {version}; open it once for writing, which brings it up.")
        self._use_log()
        with self._transaction("EXCLUSIVE"):
            for migration in _MIGRATIONS[self._version() :]:  # another process may have been faster
                for statement in migration.split(";"):
                    self._connection.execute(statement)
            self._connection.execute(f"PRAGMA application_id = {_APPLICATION}")
            self._connection.execute(f"PRAGMA user_version = {VERSION}")

    def _version(self) -> int:
        """Return the version of the file, 0 if it is new; a later version or another program's file is refused."""
        version, application, tables = (
            self._connection.execute(query).fetchone()[0]
            for query in ("PRAGMA user_version", "PRAGMA application_id", "SELECT count(*) FROM sqlite_master")
        )
        if tables and application != _APPLICATION:
            raise JaxmarkError(f"{self.path} is another program's database, no catalogue of jaxmark.")
        if version > VERSION:
            raise JaxmarkError(
                f"The catalogue {self.path} is of version {version}; this jaxmark reads up to {VERSION}, so use a later"
                " one."
            )
        return version if tables else 0

    def _use_log(self) -> None:
        """Turn on write-ahead logging, for which SQLite does not wait itself."""
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
        """Say in a sentence what SQLite refuses."""
        try:
            yield
        except UnicodeEncodeError as error:
            raise JaxmarkError(f"{error.object!a} is no text in UTF-8, which a catalogue holds; rename it.") from None
        except sqlite3.OperationalError as error:
            raise JaxmarkError(f"The catalogue {self.path} cannot be used: {error}.") from None
        except sqlite3.DatabaseError as error:
            raise JaxmarkError(
                f"{self.path} is no catalogue, or is damaged: {error}; take a copy, or import an export into a new one."
            ) from None
