"""`Catalogue`: originals, records, recipients and verdicts in one file."""

import json
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from jaxmark.catalogue import descriptors
from jaxmark.catalogue.database import Database
from jaxmark.catalogue.identification import Finder, Verdict
from jaxmark.catalogue.originals import meshes_of, prepare_file
from jaxmark.errors import JaxmarkError
from jaxmark.files.atomic import file_hash
from jaxmark.files.typed import normalise
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.record import Record, SceneRecord

_PACKAGES = ("jaxmark", "jax", "numpy", "scipy")


class Entry(NamedTuple):
    """An original in the catalogue."""

    id: int
    path: str  # path of its file when it was added
    content: str  # SHA-256 of the file, hexadecimal
    bytes: int  # size of the file
    copied: bool  # whether the catalogue contains a copy of the file
    meshes: int  # number of meshes
    vertices: int  # number of vertices of all meshes
    records: int  # number of records
    recipients: int  # number of recipients
    added: str  # time at which it was added, in UTC, ISO 8601


class Added(NamedTuple):
    """The result of adding a file."""

    id: int
    path: str
    status: str  # "added"; "known" if it was in the catalogue; "moved" if it was, and its file is at a new path now
    meshes: int
    skipped: Mapping[str, str]  # meshes that cannot be used, and the reasons


class Kept(NamedTuple):
    """A record in the catalogue, and the mesh of an original that it belongs to."""

    record: Record
    shape: int  # number of the mesh
    status: str  # "added", or "known" if it was in the catalogue


class Catalogue:
    """A catalogue: an SQLite file with originals, records, recipients, verdicts and commitments to keys, but no keys.

    Use it as a context manager, or close it. Several processes may use the same file, each with its own `Catalogue`. A
    `Catalogue` serves one thread at a time.
    """

    def __init__(self, path: str | os.PathLike[str], *, read_only: bool = False) -> None:
        """Open a catalogue. A new file is created by the first addition, unless it is opened for reading only.

        Raises:
            JaxmarkError: if the file cannot be opened, is no catalogue, or was made by a later version of jaxmark.
        """
        self.database = Database(path, read_only=read_only)

    def __enter__(self) -> "Catalogue":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self.database.close()

    @property
    def path(self) -> Path:
        """The path of the catalogue's file."""
        return self.database.path

    def add(self, path: str | os.PathLike[str], *, copy: bool = False) -> Added:
        """Add an original.

        If the original is in the catalogue already, only its path is updated, and only if its file has moved.

        Args:
            path: a mesh file; meshes that are too small to carry a mark are added, too.
            copy: whether to store a copy of the file in the catalogue.

        Raises:
            JaxmarkError: if the file cannot be read, if the size or area of all its meshes is 0, or if it is a copy
                that was made for a recipient.
        """
        content = file_hash(path)
        if copies := self.database.rows("SELECT recipient FROM copies WHERE file = ?", content):
            raise JaxmarkError(
                f"{path} is the copy for {copies[0]['recipient']}, not an original; add the file it was made from."
            )
        if (known := self._known(content, path)) is not None:
            return known
        prepared = prepare_file(path, copy=copy)
        with self.database.writing():  # another process may have added the same file meanwhile
            number, new = self.database.insert_original({**prepared.file, "added": _now()}, prepared.shapes)
        status = "added" if new else "known"
        return Added(number, prepared.file["path"], status, len(prepared.shapes), prepared.skipped)

    def _known(self, content: str, path: str | os.PathLike[str]) -> Added | None:
        """Look for a file in the catalogue; update its descriptors if they are of another version, and its path."""
        query = (
            "SELECT o.id, o.path, count(*) AS meshes, min(s.described) AS described FROM originals o"
            " JOIN shapes s ON s.original = o.id WHERE content = ? GROUP BY o.id"
        )
        rows = self.database.rows(query, content)
        if not rows:
            return None
        (row,) = rows
        if row["described"] != descriptors.VERSION:
            prepared, names = prepare_file(path), ("described", "whole", "parts", "points", "landmarks")
            update = f"UPDATE shapes SET {', '.join(f'{name} = ?' for name in names)} WHERE original = ? AND name = ?"
            with self.database.writing():
                for shape in prepared.shapes:
                    self.database.run(update, *(shape[name] for name in names), row["id"], shape["name"])
        status, new_path = "known", os.path.realpath(path)
        if row["path"] != new_path and not Path(row["path"]).is_file():
            with self.database.writing():
                self.database.run("UPDATE originals SET path = ? WHERE id = ?", new_path, row["id"])
            status = "moved"
        return Added(row["id"], new_path if status == "moved" else row["path"], status, row["meshes"], {})

    def add_record(self, record: Record | SceneRecord) -> list[Kept]:
        """Add the record of a mark, or the records of a file of several meshes, to their originals.

        Raises:
            JaxmarkError: if the original of a record is not in the catalogue, or the scheme is blind, so that its
                records have no original.
        """
        records = [record] if isinstance(record, Record) else list(record.meshes.values())
        with self.database.writing():
            return [self._store(entry, self._shape_of(entry)) for entry in records]

    def add_copy(self, record: Record, recipient: str, file: str) -> Kept:
        """Add a recipient's copy.

        Args:
            record: record of the fingerprint.
            recipient: the recipient's identifier.
            file: SHA-256 of the copy's file, hexadecimal.

        Raises:
            JaxmarkError: see `add_record`; also if the record is not of a fingerprint, or the identifier is empty.
        """
        if record.content != "fingerprint":
            raise JaxmarkError(f"The record is of a {record.content}, not of a recipient's copy; add it as a record.")
        recipient = normalise(recipient)
        if not recipient:
            raise JaxmarkError("A recipient's identifier must not be empty.")
        with self.database.writing():
            kept = self._store(record, self._shape_of(record))
            self.database.run(
                "INSERT INTO copies (shape, key, recipient, record, file, added) VALUES (?, ?, ?, ?, ?, ?)"
                " ON CONFLICT (shape, key, recipient) DO UPDATE SET record = excluded.record, file = excluded.file",
                kept.shape,
                record.key,
                recipient,
                record.digest(),
                file,
                _now(),
            )
        return kept

    def _shape_of(self, record: Record) -> int:
        """Find the mesh that a record was made for."""
        if not record.original:
            raise JaxmarkError(
                f"Records of the blind scheme {record.scheme!r} have no original; read such marks by `jaxmark detect`,"
                " which needs no catalogue."
            )
        column = "exact" if record.version == 1 else "geometry"
        rows = self.database.rows(f"SELECT id FROM shapes WHERE {column} = ? ORDER BY id", record.original)
        if not rows:
            raise JaxmarkError("The record's original is not in the catalogue; add the file that was marked.")
        return rows[0]["id"]

    def _store(self, record: Record, shape: int) -> Kept:
        self.database.insert("keys", {"commitment": record.key, "added": _now()})
        row = {"digest": record.digest(), "shape": shape, "key": record.key, "content": record.content}
        new = self.database.insert("records", {**row, "json": record.to_json(), "added": _now()})
        return Kept(record, shape, "added" if new else "known")

    def originals(self) -> list[Entry]:
        """Return all originals, in the order in which they were added."""
        query = (
            "SELECT o.id, o.path, o.content, o.bytes, o.copy IS NOT NULL AS copied, count(*) AS meshes,"
            " sum(s.vertices) AS vertices,"
            " sum((SELECT count(*) FROM records r WHERE r.shape = s.id)) AS records,"
            " sum((SELECT count(*) FROM copies c WHERE c.shape = s.id)) AS recipients, o.added"
            " FROM originals o JOIN shapes s ON s.original = o.id GROUP BY o.id ORDER BY o.id"
        )
        return [Entry(*row)._replace(copied=bool(row["copied"])) for row in self.database.rows(query)]

    def find_original(self, name: str) -> Entry:
        """Return an original by its number, its path, or the beginning of its hash (at least eight digits).

        Raises:
            JaxmarkError: if there is no such original, or several.
        """
        real_path = os.path.realpath(name)
        matching = [
            entry
            for entry in self.originals()
            if str(entry.id) == name
            or entry.path in (name, real_path)
            or (len(name) >= 8 and entry.content.startswith(name.lower()))
        ]
        if not matching:
            raise JaxmarkError(f"The catalogue has no original {name}; `jaxmark catalogue list` shows all of them.")
        if len(matching) > 1:
            numbers = ", ".join(str(entry.id) for entry in matching)
            raise JaxmarkError(f"{name} matches several originals, {numbers}; give one by its number.")
        return matching[0]

    def show(self, name: str) -> dict[str, Any]:
        """Return an original with its meshes, records and copies, as values for JSON; see `find_original`."""
        entry = self.find_original(name)
        shapes = "SELECT id, name, geometry, vertices, faces FROM shapes WHERE original = ? ORDER BY id"
        records = "SELECT digest, key, content, added FROM records WHERE shape = ? ORDER BY added, digest"
        copies = "SELECT recipient, key, record, file, added FROM copies WHERE shape = ? ORDER BY id"
        return entry._asdict() | {
            "shapes": [
                {
                    **{name: row[name] for name in ("name", "geometry", "vertices", "faces")},
                    "records": [dict(record) for record in self.database.rows(records, row["id"])],
                    "copies": [dict(copy) for copy in self.database.rows(copies, row["id"])],
                }
                for row in self.database.rows(shapes, entry.id)
            ]
        }

    def thumbnail(self, original: int) -> bytes:
        """Return the thumbnail of an original, as PNG.

        Raises:
            JaxmarkError: if there is no original with this number.
        """
        rows = self.database.rows("SELECT thumbnail FROM originals WHERE id = ?", original)
        if not rows:
            raise JaxmarkError(f"The catalogue has no original {original}.")
        return rows[0]["thumbnail"]

    def remove(self, name: str, *, records: bool = False) -> Entry:
        """Remove an original.

        Args:
            name: see `find_original`.
            records: whether its records and recipients may be removed, too.

        Raises:
            JaxmarkError: if there is no such original, or it has records or recipients that may not be removed.
        """
        with self.database.writing():
            entry = self.find_original(name)
            if (entry.records or entry.recipients) and not records:
                raise JaxmarkError(
                    f"{entry.path} has {entry.records} records and {entry.recipients} recipients, without which its"
                    " copies cannot be traced; export the catalogue first, and then remove them by --with-records."
                )
            self.database.run("DELETE FROM originals WHERE id = ?", entry.id)
        return entry

    def check(self) -> Iterator[tuple[Entry, str | None]]:
        """Yield each original, and the problem of its file: missing, changed or unreadable; None without a problem."""
        for entry in self.originals():
            problem = _problem(Path(entry.path), entry.bytes, entry.content)
            yield entry, f"{problem}, but the catalogue has a copy" if problem and entry.copied else problem

    def load(self, shape: int) -> Mesh:
        """Read the mesh of an original, from its file if that is unchanged, else from the copy in the catalogue.

        Raises:
            JaxmarkError: if the file is missing, changed or unreadable, and there is no copy; or it lacks the mesh.
        """
        query = (
            "SELECT s.name, o.path, o.content, o.bytes, o.copy FROM shapes s JOIN originals o ON o.id = s.original"
            " WHERE s.id = ?"
        )
        (row,) = self.database.rows(query, shape)
        path = Path(row["path"])
        if _problem(path, row["bytes"], row["content"]) is None:
            return _mesh_of(path, row["name"])
        if row["copy"] is None:
            raise JaxmarkError(
                f"The original {path} is missing or has changed; restore it, or add it again from its new path."
            )
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / f"original{path.suffix}"
            file.write_bytes(row["copy"])
            try:
                return _mesh_of(file, row["name"])
            except JaxmarkError as error:
                said = str(error).replace(str(file), f"the copy of {path} in the catalogue {self.database.path}")
                raise JaxmarkError(said) from None

    def find(self, suspect: str | os.PathLike[str] | Mesh, keys: Sequence[bytes], **options: Any) -> Verdict:
        """Find the originals that a suspect was made from.

        The options are those of `Finder`, which is faster for several suspects.

        Raises:
            JaxmarkError: see `Finder`.
        """
        return Finder(self, keys, **options).find(suspect)

    def record_verdict(self, suspect: str, path: str, result: Mapping[str, Any]) -> None:
        """Keep a verdict.

        Args:
            suspect: SHA-256 of the suspect's file, hexadecimal.
            path: the suspect's file.
            result: the verdict as values for JSON.
        """
        versions = json.dumps({name: version(name) for name in _PACKAGES})
        row = {"suspect": suspect, "path": path, "given": _now(), "versions": versions, "result": json.dumps(result)}
        with self.database.writing():
            self.database.insert("verdicts", row)

    def verdicts(self) -> Iterator[dict[str, Any]]:
        """Yield all stored verdicts, the oldest first."""
        for row in self.database.each("SELECT suspect, path, given, versions, result FROM verdicts ORDER BY id"):
            yield dict(row) | {name: json.loads(row[name]) for name in ("versions", "result")}


def _problem(path: Path, size: int, content: str) -> str | None:
    """Return the problem of an original's file; None if it is readable and unchanged."""
    try:
        if not path.is_file():
            return "its file is missing"
        return "its file has changed" if path.stat().st_size != size or file_hash(path) != content else None
    except (JaxmarkError, OSError):
        return "its file cannot be read"


def _mesh_of(path: Path, name: str) -> Mesh:
    """Read a mesh of a file by its name.

    Raises:
        JaxmarkError: if the file cannot be read, or has no such mesh.
    """
    meshes = meshes_of(path).meshes
    if name not in meshes:
        raise JaxmarkError(f"The original {path} has no mesh {name!r}; remove it from the catalogue, and add it again.")
    return meshes[name]


def _now() -> str:
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
