"""Methods of one's own: a Python file, or a TOML file that names two programs."""

import hashlib
import importlib.util
import json
import os
import shlex
import string
import subprocess
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from jaxmark.bench.method import METHODS, Bits, Method, Reading, get_method
from jaxmark.errors import JaxmarkError
from jaxmark.files import load_mesh, save_mesh
from jaxmark.files.atomic import read_file
from jaxmark.geometry.mesh import Mesh

Given = str | Path | Method  # a name in `METHODS`, a file, or a method itself
_MAX_FILE_BYTES = 2**20
_SECONDS = 600.0  # that a program may take
_FIELDS: Mapping[str, tuple[type, ...]] = {
    "name": (str,),
    "embed": (str,),
    "read": (str,),
    "blind": (bool,),
    "bits": (int,),
    "strengths": (list,),
    "source": (str,),
    "anchor": (str,),
    "threshold": (int, float),
    "rate": (int, float),
    "suffix": (str,),
}
_NEEDED = ("name", "embed", "read", "blind", "bits", "strengths")


def load_method(given: Given, bits: int) -> Method:
    """A method from whatever names it, for messages of so many bits if it has a choice.

    Args:
        given: a name in `METHODS`; a file `.py` with a function `method(bits)` that makes a `Method`, or with one named
            `METHOD`; a file `.toml`, see `docs/how-to/benchmark.md`; or a method.
        bits: size of the message.

    Raises:
        JaxmarkError: if there is none of that name, or the file declares none.
    """
    if isinstance(given, Method):
        return given
    if isinstance(given, str) and given in METHODS:
        return get_method(given, bits)
    path = Path(given)
    if path.suffix not in (".py", ".toml"):
        return get_method(str(given), bits)  # which refuses, and names those that there are
    return _loaded(path.resolve(), digest_of(path), bits)


def digest_of(path: Path) -> str:
    """The first digits of the hash of a file that declares a method, so that an edited one is measured anew.

    Of a TOML file the files that its commands name count, too.

    Raises:
        JaxmarkError: if it cannot be read.
    """
    try:
        content = read_file(path, _MAX_FILE_BYTES)
        digests = [hashlib.sha256(content)]
        for program in _files_in(content.decode(errors="replace"), path.parent) if path.suffix == ".toml" else []:
            with program.open("rb") as file:
                digests.append(hashlib.file_digest(file, "sha256"))
        return hashlib.sha256(b"".join(one.digest() for one in digests)).hexdigest()[:8]
    except OSError as error:
        raise JaxmarkError(f"Cannot read {os.fspath(path)}: {error.strerror or error}.") from None


def _files_in(text: str, folder: Path) -> list[Path]:
    """The files of a folder that words of a text name."""
    words = {word.strip("\"'").removeprefix("./") for word in text.split()}
    return [file for file in sorted(folder.iterdir()) if file.name in words and file.is_file()]


@lru_cache(maxsize=32)
def _loaded(path: Path, digest: str, bits: int) -> Method:
    made = _from_python(path, digest, bits) if path.suffix == ".py" else _from_toml(path, bits)
    if not isinstance(made, Method):
        raise JaxmarkError(f"{path} has no method: define METHOD, or a function method(bits) that returns a Method.")
    if not 0 < made.strengths[0] < made.strengths[1]:
        raise JaxmarkError(f"{path}: strengths are the weakest and the strongest, both above 0, got {made.strengths}.")
    return made


def _from_python(path: Path, digest: str, bits: int) -> Any:
    spec = importlib.util.spec_from_file_location(f"jaxmark_method_{digest}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
        return module.method(bits) if hasattr(module, "method") else getattr(module, "METHOD", None)
    except Exception as error:
        raise JaxmarkError(f"{path} does not run: {type(error).__name__}: {error}.") from error


def _from_toml(path: Path, bits: int) -> Method:
    try:
        declared = tomllib.loads(read_file(path, _MAX_FILE_BYTES).decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise JaxmarkError(f"{path} is no TOML: {error}.") from None
    if gone := [name for name in _NEEDED if name not in declared]:
        raise JaxmarkError(f"{path} declares no {gone[0]}; a method has {', '.join(_NEEDED)}.")
    for name, value in declared.items():
        if name not in _FIELDS or not isinstance(value, _FIELDS[name]):
            raise JaxmarkError(
                f"{path}: {name} is no field of a method, or of another type; it has {', '.join(_FIELDS)}."
            )
    own = {name: value for name, value in declared.items() if name not in ("embed", "read", "suffix", "strengths")}
    if len(declared["strengths"]) != 2:
        raise JaxmarkError(f"{path}: strengths are two numbers, the weakest and the strongest.")
    _check_places(path, declared["embed"], ("original", "marked", "message", "key", "strength"))
    _check_places(path, declared["read"], ("suspect", "key") if declared["blind"] else ("suspect", "key", "original"))
    suffix, folder = declared.get("suffix", ".obj"), str(path.parent)
    return Method(
        embed=partial(_embed, shlex.split(declared["embed"]), folder, suffix),
        read=partial(_read, shlex.split(declared["read"]), folder, suffix),
        strengths=(float(declared["strengths"][0]), float(declared["strengths"][1])),
        **own,
    )


def _check_places(path: Path, command: str, known: Sequence[str]) -> None:
    try:
        named = {name for _, name, _, _ in string.Formatter().parse(command) if name is not None}
    except ValueError as error:
        raise JaxmarkError(f"{path}: {command!r}: {error}.") from None
    if unknown := sorted(named - set(known)):
        raise JaxmarkError(f"{path}: {command!r} has {{{unknown[0]}}}; here there are {', '.join(known)}.")


def _embed(
    command: Sequence[str], home: str, suffix: str, mesh: Mesh, message: Bits, key: bytes, strength: float
) -> Mesh:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save_mesh(mesh, folder / f"original{suffix}")
        files = {"original": folder / f"original{suffix}", "marked": folder / f"marked{suffix}"}
        _run(command, home, files, message="".join(map(str, message.astype(int))), key=key.hex(), strength=strength)
        return load_mesh(files["marked"])


def _read(command: Sequence[str], home: str, suffix: str, suspect: Mesh, key: bytes, original: Mesh | None) -> Reading:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files = {"suspect": folder / f"suspect{suffix}"}
        save_mesh(suspect, files["suspect"])
        if original is not None:
            files["original"] = folder / f"original{suffix}"
            save_mesh(original, files["original"])
        said = _run(command, home, files, key=key.hex())
    try:
        found = json.loads(said)
        bits = found.get("message")
        message = None if bits is None else np.array([bit == "1" for bit in bits], bool)
        return Reading(message, float(found["score"]), found.get("log10_p"))
    except (ValueError, KeyError, TypeError, AttributeError):
        raise JaxmarkError(f'{command[0]} must print {{"message": "0110", "score": 1.5}}, got {said[:80]!r}.') from None


def _run(command: Sequence[str], home: str, files: Mapping[str, Path], **values: Any) -> str:
    """Run a program on files, in the folder of its declaration, and return what it prints."""
    line = [part.format(**files, **values) for part in command]
    try:
        done = subprocess.run(line, cwd=home, capture_output=True, text=True, timeout=_SECONDS, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise JaxmarkError(f"{command[0]} did not run: {error}.") from None
    if done.returncode:
        raise JaxmarkError(f"{command[0]} ended with status {done.returncode}: {done.stderr.strip()[-200:]}")
    return done.stdout
