"""A catalogue as JSON Lines: one line a thing, to be kept elsewhere, merged or read by other programs."""

import base64
import json
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxmark.catalogue.catalogue import Catalogue
from jaxmark.catalogue.descriptors import CENTRES, LOCAL_SIZE, POINTS, VERSION, WHOLE_SIZE
from jaxmark.catalogue.landmarks import is_whole
from jaxmark.errors import JaxmarkError
from jaxmark.files.atomic import replacing
from jaxmark.watermark.record import Record

_FORMAT, _FORMAT_VERSION = "jaxmark-catalogue", 1
_MAX_LINE_BYTES = 2**30
_Row = Mapping[str, Any]

_Types = Mapping[str, Any]
_ORIGINAL: _Types = {
    "content": str,
    "path": str,
    "bytes": int,
    "copy": bytes | None,
    "thumbnail": bytes | None,
    "added": str,
}
_SHAPE: _Types = {
    **dict.fromkeys(("name", "geometry", "exact"), str),
    **dict.fromkeys(("vertices", "faces", "described"), int),
    **dict.fromkeys(("whole", "parts", "points", "landmarks"), bytes),
}
_KEY: _Types = dict.fromkeys(("commitment", "added"), str)
_RECORD: _Types = dict.fromkeys(("original", "shape", "added", "json"), str)
_COPY: _Types = dict.fromkeys(("original", "shape", "key", "recipient", "record", "file", "added"), str)
_VERDICT: _Types = dict.fromkeys(("suspect", "path", "given", "versions", "result"), str)


class Counted(NamedTuple):
    """How much was exported, or was new when it was imported."""

    originals: int
    records: int
    recipients: int
    verdicts: int


def export_catalogue(catalogue: Catalogue, path: str | os.PathLike[str]) -> Counted:
    """Write everything that a catalogue holds to a file, which appears whole or not at all.

    Raises:
        JaxmarkError: if the file cannot be written.
    """
    counts: dict[str, int] = {}
    with replacing(Path(path)) as draft:
        try:
            with draft.open("w", encoding="utf-8") as file:
                file.write(json.dumps({"format": _FORMAT, "version": _FORMAT_VERSION}) + "\n")
                for kind, row in _rows(catalogue):
                    counts[kind] = counts.get(kind, 0) + 1
                    file.write(json.dumps({kind: row}) + "\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise JaxmarkError(f"Cannot write {path}: {error.strerror or error}.") from None
    return Counted(*(counts.get(kind, 0) for kind in ("original", "record", "copy", "verdict")))


def _rows(catalogue: Catalogue) -> Iterator[tuple[str, dict[str, Any]]]:
    """What a catalogue holds, what others refer to first."""
    database = catalogue.database
    of = "JOIN shapes s ON s.id = t.shape JOIN originals o ON o.id = s.original"
    for row in database.each(f"SELECT id, {', '.join(_ORIGINAL)} FROM originals ORDER BY id"):
        shapes = database.rows(f"SELECT {', '.join(_SHAPE)} FROM shapes WHERE original = ? ORDER BY id", row["id"])
        values = {name: _told(row[name]) for name in _ORIGINAL}
        yield "original", values | {"shapes": [{name: _told(one[name]) for name in _SHAPE} for one in shapes]}
    for row in database.each("SELECT commitment, added FROM keys ORDER BY commitment"):
        yield "key", dict(row)
    for kind, names in (("record", ("added", "json")), ("copy", ("key", "recipient", "record", "file", "added"))):
        table = {"record": "records", "copy": "copies"}[kind]
        columns = ", ".join(f"t.{name}" for name in names)
        query = f"SELECT o.content AS original, s.name AS shape, {columns} FROM {table} t {of} ORDER BY t.rowid"
        for row in database.each(query):
            yield kind, dict(row)
    for row in database.each(f"SELECT {', '.join(_VERDICT)} FROM verdicts ORDER BY id"):
        yield "verdict", dict(row)


def _told(value: Any) -> Any:
    return base64.b64encode(value).decode() if isinstance(value, bytes) else value


def import_catalogue(catalogue: Catalogue, path: str | os.PathLike[str]) -> Counted:
    """Merge an exported file into a catalogue, all of it or nothing; what is known stays as it is.

    Raises:
        JaxmarkError: if the file cannot be read, or is no export, or a line of it is damaged.
    """
    fresh = {"original": 0, "record": 0, "copy": 0, "verdict": 0, "key": 0}
    take: dict[str, Callable[[Catalogue, _Row], int]] = {
        "original": _take_original,
        "key": _take_key,
        "record": _take_record,
        "copy": _take_copy,
        "verdict": _take_verdict,
    }
    with catalogue.database.writing():
        for number, line in enumerate(_lines(path), 1):
            try:
                data = json.loads(line)
                if number == 1:
                    if data.get("format") != _FORMAT:
                        raise JaxmarkError("it is no export of a catalogue")
                    if data.get("version") != _FORMAT_VERSION:
                        raise JaxmarkError(f"its version {data.get('version')} is not one that this jaxmark reads")
                    continue
                ((kind, row),) = data.items()
                fresh[kind] += take[kind](catalogue, row)
            except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
                said = str(error).rstrip(".") if isinstance(error, JaxmarkError) else "it is damaged"
                raise JaxmarkError(f"{path} cannot be imported: line {number}: {said}.") from None
    return Counted(fresh["original"], fresh["record"], fresh["copy"], fresh["verdict"])


def _lines(path: str | os.PathLike[str]) -> Iterator[str]:
    there = False
    try:
        if not Path(path).is_file():
            raise JaxmarkError(f"{path} is no file that could be imported.")
        with Path(path).open(encoding="utf-8") as file:
            while line := file.readline(_MAX_LINE_BYTES):
                there = True
                yield line
    except (OSError, ValueError) as error:
        if isinstance(error, JaxmarkError):
            raise
        raise JaxmarkError(f"Cannot read {path}: {getattr(error, 'strerror', None) or 'it is no text'}.") from None
    if not there:
        raise JaxmarkError(f"{path} is empty, no export of a catalogue.")


def _checked(row: _Row, types: _Types) -> dict[str, Any]:
    """The fields of a row, of their types."""
    found: dict[str, Any] = {}
    for name, kind in types.items():
        value = row[name]
        if kind in (bytes, bytes | None) and isinstance(value, str):
            value = base64.b64decode(value, validate=True)
        if not isinstance(value, kind) or isinstance(value, bool):
            raise TypeError
        found[name] = value
    return found


def _take_original(catalogue: Catalogue, row: _Row) -> int:
    values = _checked(row, _ORIGINAL)
    bytes.fromhex(values["content"])
    shapes = [_checked({"landmarks": "", **shape}, _SHAPE) for shape in row["shapes"]]  # older exports have none
    for shape in shapes:
        if shape["described"] == VERSION and not (
            len(shape["whole"]) == 2 * WHOLE_SIZE
            and len(shape["parts"]) == 2 * CENTRES * LOCAL_SIZE
            and len(shape["points"]) == 2 * 3 * POINTS
            and all(np.isfinite(np.frombuffer(shape[name], "<f2")).all() for name in ("whole", "parts", "points"))
            and is_whole(shape["landmarks"])
        ):
            raise TypeError
    if not shapes:
        raise TypeError
    if not _insert(catalogue, "originals", values):
        return 0
    (original,) = catalogue.database.rows("SELECT id FROM originals WHERE content = ?", values["content"])
    for shape in shapes:
        _insert(catalogue, "shapes", {"original": original["id"], **shape})
    return 1


def _take_key(catalogue: Catalogue, row: _Row) -> int:
    return _insert(catalogue, "keys", _checked(row, _KEY))


def _take_record(catalogue: Catalogue, row: _Row) -> int:
    values = _checked(row, _RECORD)
    record = Record.of(json.loads(values["json"]), "in it")
    return _insert(
        catalogue,
        "records",
        {
            "digest": record.digest(),
            "shape": _shape(catalogue, values),
            "key": record.key,
            "content": record.content,
            "json": values["json"],
            "added": values["added"],
        },
    )


def _take_copy(catalogue: Catalogue, row: _Row) -> int:
    values = _checked(row, _COPY)
    fields = {name: values[name] for name in ("key", "recipient", "record", "file", "added")}
    if not values["recipient"]:
        raise TypeError
    return _insert(catalogue, "copies", {"shape": _shape(catalogue, values), **fields})


def _take_verdict(catalogue: Catalogue, row: _Row) -> int:
    values = _checked(row, _VERDICT)
    for name in ("versions", "result"):
        json.loads(values[name])
    query = f"SELECT 1 FROM verdicts WHERE {' AND '.join(f'{name} = ?' for name in values)}"
    if catalogue.database.rows(query, *values.values()):
        return 0
    return _insert(catalogue, "verdicts", values)


def _shape(catalogue: Catalogue, row: _Row) -> int:
    query = "SELECT s.id FROM shapes s JOIN originals o ON o.id = s.original WHERE o.content = ? AND s.name = ?"
    found = catalogue.database.rows(query, row["original"], row["shape"])
    if not found:
        raise JaxmarkError("it belongs to an original that is in neither catalogue")
    return found[0]["id"]


def _insert(catalogue: Catalogue, table: str, values: Mapping[str, Any]) -> int:
    """Insert a row unless it is there; returns how many there are more."""
    places = ", ".join("?" for _ in values)
    statement = f"INSERT INTO {table} ({', '.join(values)}) VALUES ({places}) ON CONFLICT DO NOTHING"
    return catalogue.database.run(statement, *values.values()).rowcount
