"""Unpack LAZ, compressed glTF meshes and USD in another process, whose memory and processor time are limited.

The decoders are native code that trusts counts in the data: they reserve gigabytes, or end their process.
"""

import io
import os
import shutil
import subprocess
import sys
import tempfile
import weakref
from typing import IO, Literal

import numpy as np

from jaxmark.errors import JaxmarkError, require
from jaxmark.files import limits, unpacker

#: The module of each decoder, and the extra that installs it.
_MODULES = {
    "laz": ("laspy", "files"),
    "draco": ("DracoPy", "files"),
    "meshopt": ("meshopt", "files"),
    "usd": ("pxr", "usd"),
}
_COPIES, _LEAST_BYTES = 4, 2**28  # of the unpacked content that decoders hold, and memory that they take beside it


class Unpacker:
    """A process that unpacks the packed parts of one file; it starts at the first call, and ends with this object."""

    def __init__(self, kind: Literal["laz", "draco", "meshopt", "usd"], size: int) -> None:
        """Prepare to unpack parts of a file of a size in bytes, from which its limits follow."""
        self._kind, self._size = kind, size
        self._process: subprocess.Popen[bytes] | None = None

    def __call__(self, data: bytes) -> dict[str, np.ndarray]:
        """Unpack a part of the file.

        Returns:
            For LAZ, "las": the bytes of the LAS file. For Draco, "faces", and each attribute by its identifier.
            For USD, see `usd_program`.
            For meshopt, "bytes" of the buffer view, whose form precedes the data, see `gltf.meshopt.Packing`.

        Raises:
            JaxmarkError: half a sentence, if the decoder is missing, fails, or takes more than the file's limits.
        """
        require(*_MODULES[self._kind])
        seconds = limits.UNPACKING_SECONDS.most(self._size)
        if self._process is None:
            memory = _COPIES * limits.UNPACKED.most(self._size) + _LEAST_BYTES
            # Without -P, modules beside the program would hide those of the standard library.
            command = [sys.executable, "-P", unpacker.__file__, self._kind, str(memory), str(seconds)]
            folder = tempfile.mkdtemp()  # the process may end before it removes its temporary files
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env=os.environ | {"TMPDIR": folder},
            )
            weakref.finalize(self, _end, self._process, folder)
        try:
            answer = _exchange(self._process, data)
        except (OSError, EOFError):
            raise JaxmarkError(
                f"its decoder ended; the data are damaged, or take more than {seconds} s, or too much memory for a file"
                f" of {self._size} bytes"
            ) from None
        if not answer[0]:
            raise JaxmarkError(answer[1:].decode(errors="replace"))
        with np.load(io.BytesIO(answer[1:]), allow_pickle=False) as arrays:
            return dict(arrays)


def _exchange(process: "subprocess.Popen[bytes]", data: bytes) -> bytes:
    """Send a block to the program, and receive one."""
    sent, received = process.stdin, process.stdout
    assert sent is not None
    assert received is not None
    sent.write(unpacker.LENGTH.pack(len(data)) + data)
    sent.flush()
    return _read(received, unpacker.LENGTH.unpack(_read(received, unpacker.LENGTH.size))[0])


def _read(pipe: IO[bytes], size: int) -> bytes:
    data = pipe.read(size)
    if len(data) < size:
        raise EOFError
    return data


def _end(process: "subprocess.Popen[bytes]", folder: str) -> None:
    process.kill()
    process.communicate()
    shutil.rmtree(folder, ignore_errors=True)
