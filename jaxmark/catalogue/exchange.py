"""Export and import of catalogues as JSON Lines, with one line per row."""

import base64
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxmark.catalogue.catalogue import Catalogue
from jaxmark.catalogue.database import Database
from jaxmark.catalogue.descriptors import CENTRES, LOCAL_SIZE, POINTS, VERSION, WHOLE_SIZE
from jaxmark.catalogue.landmarks import is_whole
from jaxmark.errors import JaxmarkError
from jaxmark.files.atomic import replacing
from jaxmark.watermark.record import Record

_FORMAT, _FORMAT_VERSION = "jaxmark-catalogue", 2
_OPEN_VERSION = 1  # which does not end with the number of its rows
_END = "rows"  # the last line has this number, by which a file that was cut is recognised
_MAX_LINE_BYTES = 2**30
_TABLES = {"original": "originals", "key": "keys", "record": "records", "copy": "copies", "verdict": "verdicts"}
# The fields of each kind of row. In records and copies, `original` and `shape` identify a mesh by the hash of its file
# and its name, because the numbers of meshes differ between catalogues.
_FIELDS: dict[str, dict[str, Any]] = {
    "original": {
        **dict.fromkeys(("content", "path"), str),
        "bytes": int,
        **dict.fromkeys(("copy", "thumbnail"), bytes | None),
        "added": str,
    },
    "key": dict.fromkeys(("commitment", "added"), str),
    "record": dict.fromkeys(("original", "shape", "added", "json"), str),
    "copy": dict.fromkeys(("original", "shape", "key", "recipient", "record", "file", "added"), str),
    "verdict": dict.fromkeys(("suspect", "path", "given", "versions", "result"), str),
}
_KEY, _RECORD = ("key", "keys", "commitment"), ("record", "records", "digest")
_REFERENCES = {"record": (_KEY,), "copy": (_KEY, _RECORD)}  # fields that refer to a row, its table and its column
_SHAPE: dict[str, Any] = {
    **dict.fromkeys(("name", "geometry", "exact"), str),
    **dict.fromkeys(("vertices", "faces", "described"), int),
    **dict.fromkeys(("whole", "parts", "points", "landmarks"), bytes),
}


class Counted(NamedTuple):
    """The numbers of rows that were exported; or of rows that were imported and new."""

    originals: int
    records: int
    recipients: int
    verdicts: int


def export_catalogue(catalogue: Catalogue, path: str | os.PathLike[str]) -> Counted:
    """Write the whole content of a catalogue to a file, atomically.

    Raises:
        JaxmarkError: if the file cannot be written.
    """
    counts = dict.fromkeys(_TABLES, 0)
    with replacing(Path(path)) as draft:
        try:
            with draft.open("w", encoding="utf-8") as file:
                file.write(json.dumps({"format": _FORMAT, "version": _FORMAT_VERSION}) + "\n")
                for kind, row in _rows(catalogue.database):
                    counts[kind] += 1
                    file.write(json.dumps({kind: row}, default=lambda data: base64.b64encode(data).decode()) + "\n")
                file.write(json.dumps({_END: sum(counts.values())}) + "\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise JaxmarkError(f"Cannot write {path}: {error.strerror or error}.") from None
    return _counted(counts)


def _counted(counts: Mapping[str, int]) -> Counted:
    return Counted(*(counts[kind] for kind in ("original", "record", "copy", "verdict")))


def _rows(database: Database) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the rows of a catalogue with their kinds; each row follows the rows that it refers to."""
    of = "JOIN shapes s ON s.id = t.shape JOIN originals o ON o.id = s.original"
    columns = {kind: ", ".join(fields) for kind, fields in _FIELDS.items()}
    for row in database.each(f"SELECT {columns['original']}, id FROM originals ORDER BY id"):
        shapes = database.rows(f"SELECT {', '.join(_SHAPE)} FROM shapes WHERE original = ? ORDER BY id", row["id"])
        values = {name: row[name] for name in _FIELDS["original"]}
        yield "original", values | {"shapes": [dict(shape) for shape in shapes]}
    queries = {"key": f"SELECT {columns['key']} FROM keys ORDER BY commitment"}
    for kind in ("record", "copy"):
        own = ", ".join(f"t.{name}" for name in _FIELDS[kind] if name not in ("original", "shape"))
        queries[kind] = (
            f"SELECT o.content AS original, s.name AS shape, {own} FROM {_TABLES[kind]} t {of} ORDER BY t.rowid"
        )
    queries["verdict"] = f"SELECT {columns['verdict']} FROM verdicts ORDER BY id"
    for kind, query in queries.items():
        for row in database.each(query):
            yield kind, dict(row)


def import_catalogue(catalogue: Catalogue, path: str | os.PathLike[str]) -> Counted:
    """Merge an exported file into a catalogue; existing rows do not change.

    Raises:
        JaxmarkError: if the file cannot be read, or is no export, or a line of it is damaged; then nothing is imported.
    """
    counts = dict.fromkeys(_TABLES, 0)
    number, version, is_complete = 0, 0, False
    with catalogue.database.writing():
        for number, line in enumerate(_lines(path), 1):
            try:
                data = json.loads(line)
                if number == 1:
                    if data.get("format") != _FORMAT:
                        raise JaxmarkError("it is not the export of a catalogue")
                    if data.get("version") not in (_OPEN_VERSION, _FORMAT_VERSION):
                        raise JaxmarkError(f"this jaxmark cannot read the version {data.get('version')} of the export")
                    version = data["version"]
                    continue
                ((kind, row),) = data.items()
                if version == _FORMAT_VERSION and (is_complete or kind == _END):
                    if is_complete or row != number - 2:
                        raise JaxmarkError("the file has other rows than were exported")
                    is_complete = True
                    continue
                counts[kind] += _take(catalogue.database, kind, row)
            except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
                reason = str(error).rstrip(".") if isinstance(error, JaxmarkError) else "it is damaged"
                raise JaxmarkError(f"{path} cannot be imported: line {number}: {reason}.") from None
        if version == _FORMAT_VERSION and not is_complete:
            raise JaxmarkError(f"{path} cannot be imported: it was cut after line {number}; export it again.")
    return _counted(counts)


def _lines(path: str | os.PathLike[str]) -> Iterator[str]:
    try:
        if not Path(path).is_file():
            raise JaxmarkError(f"{path} is not a file; give one that `jaxmark catalogue export` wrote.")
        with Path(path).open(encoding="utf-8-sig") as file:
            if not (line := file.readline(_MAX_LINE_BYTES)):
                raise JaxmarkError(f"{path} is empty; give a file that `jaxmark catalogue export` wrote.")
            while line:
                yield line
                line = file.readline(_MAX_LINE_BYTES)
    except JaxmarkError:
        raise
    except (OSError, ValueError) as error:
        raise JaxmarkError(f"Cannot read {path}: {getattr(error, 'strerror', None) or 'it is not text'}.") from None


def _take(database: Database, kind: str, row: Mapping[str, Any]) -> bool:
    """Insert a row unless it exists; returns whether it is new."""
    values = _checked(row, _FIELDS[kind])
    match kind:
        case "original":
            return _take_original(database, values, row["shapes"])
        case "record":
            record = Record.of(json.loads(values["json"]), "in it")
            values |= {"digest": record.digest(), "key": record.key, "content": record.content}
        case "copy":
            if not values["recipient"]:
                raise TypeError
        case "verdict":
            for name in ("versions", "result"):
                json.loads(values[name])
            query = f"SELECT 1 FROM verdicts WHERE {' AND '.join(f'{name} = ?' for name in values)}"
            if database.rows(query, *values.values()):
                return False
    for name, table, column in _REFERENCES.get(kind, ()):
        if not database.rows(f"SELECT 1 FROM {table} WHERE {column} = ?", values[name]):
            raise JaxmarkError(f"its {name} is neither in the export nor in the catalogue")
    if "shape" in values:
        query = "SELECT s.id FROM shapes s JOIN originals o ON o.id = s.original WHERE o.content = ? AND s.name = ?"
        shapes = database.rows(query, values.pop("original"), values["shape"])
        if not shapes:
            raise JaxmarkError("its original is neither in the export nor in the catalogue")
        values["shape"] = shapes[0]["id"]
    return database.insert(_TABLES[kind], values)


def _take_original(database: Database, values: Mapping[str, Any], rows: list[Mapping[str, Any]]) -> bool:
    """Insert an original and its meshes unless it exists; returns whether it is new."""
    bytes.fromhex(values["content"])
    shapes = [_checked({"landmarks": "", **row}, _SHAPE) for row in rows]  # older exports have no landmarks
    sizes = {"whole": 2 * WHOLE_SIZE, "parts": 2 * CENTRES * LOCAL_SIZE, "points": 2 * 3 * POINTS}
    for shape in shapes:
        if shape["described"] == VERSION and not (
            all(len(shape[name]) == size for name, size in sizes.items())
            and all(np.isfinite(np.frombuffer(shape[name], "<f2")).all() for name in sizes)
            and is_whole(shape["landmarks"])
        ):
            raise TypeError
    if not shapes:
        raise TypeError
    return database.insert_original(values, shapes)[1]


def _checked(row: Mapping[str, Any], types: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a row; raise KeyError for a missing field, and TypeError or ValueError for a wrong value."""
    fields: dict[str, Any] = {}
    for name, kind in types.items():
        value = row[name]
        if kind in (bytes, bytes | None) and isinstance(value, str):
            value = base64.b64decode(value, validate=True)
        if not isinstance(value, kind) or isinstance(value, bool):
            raise TypeError
        fields[name] = value
    return fields
