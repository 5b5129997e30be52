"""Methods of the benchmark: built-in methods, methods from Python files, and programs that TOML files declare."""

import hashlib
import importlib
import json
import os
import runpy
import shlex
import string
import subprocess
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from jaxmark.errors import JaxmarkError
from jaxmark.files import load_mesh, save_mesh
from jaxmark.files.atomic import read_file
from jaxmark.files.typed import parse_toml
from jaxmark.geometry.mesh import Mesh

Bits = Bool[np.ndarray, " bits"]

_BUILTIN = ("keyed", "eigen", "host", "paper", "field", "local", "rooted", "harmonics")
#: The factory of each method, which takes the payload in bits: a module of `jaxmark.bench.methods` and a function.
METHODS: Mapping[str, str] = {
    **{name: f"builtin_schemes:{name}" for name in _BUILTIN},
    "cho": "vertex_norms:cho",
    "cho-variance": "vertex_norms:cho_variance",
    "radial": "radial:radial",
    "wang": "moments:moments",
    "praun": "influence:influence",
}


class Reading(NamedTuple):
    """The result of one reading of a suspect."""

    message: Bits | None  # the best guess; None if the reader makes none
    score: float  # rises with the evidence for a mark of this key; the benchmark calibrates it
    log10_p: float | None = None  # log10 of the false-positive probability, if the method proves a bound


@dataclass(frozen=True)
class Method:
    """A watermarking method, as the benchmark calls it.

    `embed(mesh, message, key, strength)` returns the marked mesh. `read(suspect, key, original)` returns a `Reading`;
    `original` is None for a blind method. Keys are 32 bytes. Strengths are in the method's own unit: the benchmark
    searches between the two values of `strengths` for the largest strength that the distortion limits allow.
    """

    name: str
    embed: Callable[[Mesh, Bits, bytes, float], Mesh]
    read: Callable[[Mesh, bytes, Mesh | None], Reading]
    blind: bool
    bits: int  # payload in bits; 0 for a method that shows presence only
    strengths: tuple[float, float]  # the smallest and the largest strength, both above 0
    source: str = ""  # the publication
    anchor: str = ""  # the published figure that this code was validated against and meets; empty for 'not validated'
    threshold: float | None = None  # the score from which the method itself reports a mark
    rate: float = 1e-6  # the false-positive rate that the method states for its threshold


Given = str | Path | Method  # a name in `METHODS`, a file, or a method itself
_MAX_FILE_BYTES = 2**20
_TIMEOUT = 600.0  # seconds after which a program is ended
_REQUIRED: Mapping[str, Any] = {"name": str, "embed": str, "read": str, "blind": bool, "bits": int, "strengths": list}
_OPTIONAL = {"source": str, "anchor": str, "threshold": int | float, "rate": int | float, "suffix": str}
_FIELDS = {**_REQUIRED, **_OPTIONAL}


def get_method(name: str, bits: int) -> Method:
    """Make the method with a name in `METHODS`, for a payload in bits.

    Raises:
        JaxmarkError: if there is no method of that name.
    """
    if name not in METHODS:
        raise JaxmarkError(f"There is no method {name!r}; there are {', '.join(METHODS)}, and files of your own.")
    module, _, function = METHODS[name].partition(":")
    made = getattr(importlib.import_module(f"jaxmark.bench.methods.{module}"), function)(bits)
    return replace(made, name=name)


def load_method(given: Given, bits: int) -> Method:
    """Load a method for a given payload, if it supports several.

    Args:
        given: a name in `METHODS`; a file `.py` with a function `method(bits)` that returns a `Method`, or with a
            `Method` named `METHOD`; a file `.toml`, see `docs/how-to/benchmark.md`; or a method.
        bits: payload in bits.

    Raises:
        JaxmarkError: if there is no method of that name, or the file declares no method.
    """
    if isinstance(given, Method):
        return given
    path = Path(given)
    if given in METHODS or path.suffix not in (".py", ".toml"):
        return get_method(str(given), bits)
    return _load(path.resolve(), digest_of(path), bits)


def digest_of(path: Path) -> str:
    """Hash a file that declares a method, and the files that its commands name; an edited method thus runs again."""
    try:
        content = read_file(path, _MAX_FILE_BYTES)
        digests = [hashlib.sha256(content).digest()]
        if path.suffix == ".toml":
            words = {word.strip("\"'").removeprefix("./") for word in content.decode(errors="replace").split()}
            files = [file for file in sorted(path.parent.iterdir()) if file.name in words and file.is_file()]
            digests += [hashlib.sha256(file.read_bytes()).digest() for file in files]
        return hashlib.sha256(b"".join(digests)).hexdigest()[:8]
    except OSError as error:
        raise JaxmarkError(f"Cannot read {os.fspath(path)}: {error.strerror or error}.") from None


@lru_cache(maxsize=32)
def _load(path: Path, digest: str, bits: int) -> Method:
    made = _from_python(path, digest, bits) if path.suffix == ".py" else _from_toml(path)
    if not isinstance(made, Method):
        raise JaxmarkError(f"{path} has no method: define METHOD, or a function method(bits) that returns a Method.")
    if not 0 < made.strengths[0] < made.strengths[1]:
        raise JaxmarkError(
            f"{path}: strengths must be two numbers above 0, the smaller one first, got {made.strengths}."
        )
    return made


def _from_python(path: Path, digest: str, bits: int) -> Any:
    try:
        names = runpy.run_path(str(path), run_name=f"jaxmark_method_{digest}")
        return names["method"](bits) if "method" in names else names.get("METHOD")
    except Exception as error:
        raise JaxmarkError(f"{path} does not run: {type(error).__name__}: {error}.") from error


def _from_toml(path: Path) -> Method:
    try:
        declared = parse_toml(read_file(path, _MAX_FILE_BYTES))
    except JaxmarkError as error:
        raise JaxmarkError(f"{path} is not a TOML file: {error}.") from None
    if missing := [name for name in _REQUIRED if name not in declared]:
        raise JaxmarkError(f"{path} declares no {missing[0]}; a method needs {', '.join(_REQUIRED)}.")
    for name, value in declared.items():
        if name not in _FIELDS or not isinstance(value, _FIELDS[name]):
            raise JaxmarkError(
                f"{path}: {name} is no field of a method, or its value has a wrong type; the fields are"
                f" {', '.join(_FIELDS)}."
            )
    if len(declared["strengths"]) != 2:
        raise JaxmarkError(f"{path}: strengths must be two numbers, the smallest and the largest strength.")
    embed = _split(path, declared.pop("embed"), "original", "marked", "message", "key", "strength")
    read = _split(path, declared.pop("read"), "suspect", "key", *([] if declared["blind"] else ["original"]))
    programs = _Programs(embed, read, path.parent, declared.pop("suffix", ".obj"))
    declared["strengths"] = tuple(map(float, declared["strengths"]))
    return Method(embed=programs.run_embed, read=programs.run_read, **declared)


def _split(path: Path, command: str, *allowed: str) -> list[str]:
    """Split a command into words, and check its replacement fields."""
    try:
        fields, words = {name for _, name, _, _ in string.Formatter().parse(command)}, shlex.split(command)
    except ValueError as error:
        raise JaxmarkError(f"{path}: {command!r}: {error}.") from None
    if unknown := sorted(name for name in fields if name is not None and name not in allowed):
        raise JaxmarkError(
            f"{path}: {command!r} has the field {{{unknown[0]}}}; allowed here are {', '.join(allowed)}."
        )
    return words


@dataclass(frozen=True)
class _Programs:
    """The commands of a method, which exchange meshes by files."""

    embed: Sequence[str]
    read: Sequence[str]
    home: Path  # the working directory of the commands
    suffix: str  # the suffix of mesh files

    def run_embed(self, mesh: Mesh, message: Bits, key: bytes, strength: float) -> Mesh:
        with tempfile.TemporaryDirectory() as folder:
            marked, bits = Path(folder) / f"marked{self.suffix}", "".join(map(str, message.astype(int)))
            self._run(
                self.embed, folder, {"original": mesh}, marked=marked, message=bits, key=key.hex(), strength=strength
            )
            return load_mesh(marked)

    def run_read(self, suspect: Mesh, key: bytes, original: Mesh | None) -> Reading:
        meshes = {"suspect": suspect} if original is None else {"suspect": suspect, "original": original}
        with tempfile.TemporaryDirectory() as folder:
            printed = self._run(self.read, folder, meshes, key=key.hex())
        try:
            values = json.loads(printed)
            bits = values.get("message")
            message = None if bits is None else np.array([bit == "1" for bit in bits], bool)
            return Reading(message, float(values["score"]), values.get("log10_p"))
        except (ValueError, KeyError, TypeError, AttributeError):
            raise JaxmarkError(
                f'{self.read[0]} must print {{"message": "0110", "score": 1.5}}, got {printed[:80]!r}.'
            ) from None

    def _run(self, command: Sequence[str], folder: str, meshes: Mapping[str, Mesh], **values: Any) -> str:
        """Run a program on meshes, and return its standard output."""
        for name, mesh in meshes.items():
            values[name] = Path(folder) / f"{name}{self.suffix}"
            save_mesh(mesh, values[name])
        line = [word.format(**values) for word in command]
        try:
            ended = subprocess.run(line, cwd=self.home, capture_output=True, text=True, timeout=_TIMEOUT, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise JaxmarkError(f"{command[0]} did not run: {error}.") from None
        if ended.returncode:
            raise JaxmarkError(f"{command[0]} ended with status {ended.returncode}: {ended.stderr.strip()[-200:]}")
        return ended.stdout
