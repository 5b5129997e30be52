"""Studies declared in TOML files."""

import os
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxmark.errors import JaxmarkError
from jaxmark.evaluation.study import Study
from jaxmark.files.atomic import read_file

_MAX_FILE_BYTES = 2**24  # of a TOML file


def load_study(path: str | os.PathLike[str]) -> Study:
    """Load a study from a TOML file.

    The tables `meshes` (files, relative to the TOML file's folder) and `attacks` (lists of strengths) are by name.
    `schemes` (names), `payloads`, `budgets` (numbers, names, or tables of limits) and `samples` are as in `Study`, and
    have its defaults.

    Raises:
        JaxmarkError: if the file cannot be read, is not TOML, or declares no study.
    """
    name = os.fspath(path)
    try:
        declared = tomllib.loads(read_file(path, _MAX_FILE_BYTES).decode("utf-8"))
    except OSError as error:
        raise JaxmarkError(f"Cannot read {name}: {error.strerror}.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise JaxmarkError(f"{name} is no TOML: {error}.") from None
    for field in ("meshes", "attacks"):
        if field not in declared:
            raise JaxmarkError(f"{name} declares no {field}; give a table [{field}].")
    for field, value in declared.items():
        if field not in _FIELDS:
            raise JaxmarkError(f"{name}: a study has no field {field!r}; there are {', '.join(_FIELDS)}.")
        shape, fits = _FIELDS[field]
        if not fits(value):
            raise JaxmarkError(f"{name}: {field} must be {shape}.")
    meshes = {label: Path(path).parent / file for label, file in declared["meshes"].items()}
    try:
        return Study(**{**declared, "meshes": meshes})
    except JaxmarkError as error:
        raise JaxmarkError(f"{name}: {error}") from None


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _text(value: Any) -> bool:
    return isinstance(value, str)


def _list(fits: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, list) and all(map(fits, value))


def _table(fits: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, dict) and all(map(fits, value.values()))


# What each field must be, in words and as a test.
_FIELDS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "meshes": ("a table of files", _table(_text)),
    "attacks": ("a table of lists of numbers", _table(_list(_number))),
    "schemes": ("a list of names", _list(_text)),
    "payloads": ("a list of whole numbers of bits", _list(_whole)),
    "budgets": (
        "a list of numbers, names or tables of limits",
        _list(lambda one: _number(one) or _text(one) or (bool(one) and _table(_number)(one))),
    ),
    "samples": ("a whole number", _whole),
}
