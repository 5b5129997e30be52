"""A program that unpacks LAZ, glTF and USD for `jaxmark.files.unpacking`; it imports nothing of jaxmark.

It reads blocks from its standard input, and answers each by a block on its standard output. A block is its length in
eight bytes, and the bytes. An answer begins with a byte: 1, then arrays in NumPy's format npz; or 0, then an error.
"""

import io
import json
import os
import re
import runpy
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

LENGTH = struct.Struct("<Q")
_STATUS, _DATA = Path("/proc/self/status"), re.compile(r"^VmData:\s*(\d+) kB$", re.MULTILINE)


def limit_memory(most_bytes: int) -> None:
    """Limit the memory that the process may take in addition to what it has now; does nothing but on Linux."""
    try:
        found = _DATA.search(_STATUS.read_text())
    except OSError:
        return
    if found is not None:
        _limit("RLIMIT_DATA", 1024 * int(found[1]) + most_bytes)


def _limit(name: str, most: int) -> None:
    """Lower a limit of the system; does nothing where the system has none."""
    try:
        import resource
    except ImportError:
        return
    kind = getattr(resource, name)
    _, before = resource.getrlimit(kind)
    most = most if before == resource.RLIM_INFINITY else min(most, before)
    resource.setrlimit(kind, (most, most))


def _laz() -> Callable[[bytes], dict[str, np.ndarray]]:
    import laspy

    def unpack(data: bytes) -> dict[str, np.ndarray]:
        out = io.BytesIO()
        cloud = laspy.read(io.BytesIO(data))
        for records in (cloud.header.vlrs, cloud.header.evlrs or []):
            # The octree of a cloud-optimised point cloud says where packed points lie, and laspy does not write it.
            records[:] = [record for record in records if record.user_id != "copc"]
        cloud.write(out, do_compress=False)
        return {"las": np.frombuffer(out.getvalue(), np.uint8)}

    return unpack


def _draco() -> Callable[[bytes], dict[str, np.ndarray]]:
    import DracoPy

    def unpack(data: bytes) -> dict[str, np.ndarray]:
        found: Any = DracoPy.decode(data)
        attributes = {str(item["unique_id"]): np.asarray(item["data"]) for item in found.attributes}
        return {"faces": np.asarray(found.faces, np.int64).reshape(-1, 3), **attributes}

    return unpack


def _meshopt() -> Callable[[bytes], dict[str, np.ndarray]]:
    import meshopt

    def unpack(data: bytes) -> dict[str, np.ndarray]:
        form, _, packed = data.partition(b"\n")
        rows = meshopt.decode_gltf_buffer(packed, *json.loads(form))
        return {"bytes": np.ascontiguousarray(rows).reshape(-1).view(np.uint8)}

    return unpack


def _usd() -> Callable[[bytes], dict[str, np.ndarray]]:
    return runpy.run_path(str(Path(__file__).with_name("usd_program.py")))["unpack"]


def _answer(unpack: Callable[[bytes], dict[str, np.ndarray]], data: bytes) -> bytes:
    try:
        out = io.BytesIO()
        np.savez(out, allow_pickle=False, **unpack(data))
        return b"\1" + out.getvalue()
    except MemoryError:
        return b"\0it takes more memory than its size allows"
    except BaseException as error:  # a panic of laspy's decoder is no Exception
        return b"\0" + (" ".join(str(error).split()) or type(error).__name__)[:200].encode(errors="replace")


def _main(kind: str, most_bytes: str, most_seconds: str) -> None:
    # Whatever decoders print goes elsewhere.
    out = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    unpack = {"laz": _laz, "draco": _draco, "meshopt": _meshopt, "usd": _usd}[kind]()
    limit_memory(int(most_bytes))
    _limit("RLIMIT_CPU", int(most_seconds))
    while head := sys.stdin.buffer.read(LENGTH.size):
        answer = _answer(unpack, sys.stdin.buffer.read(LENGTH.unpack(head)[0]))
        out.write(LENGTH.pack(len(answer)) + answer)
        out.flush()


if __name__ == "__main__":
    _main(*sys.argv[1:])
