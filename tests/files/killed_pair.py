"""Kill a process at each of its calls to the file system while it writes a pair. A program: it forks, without JAX.

Arguments: FOLDER, "overwrite" or "new", and a file with the new record. For each call, `FOLDER/before` is copied to
`FOLDER/NUMBER`, and a child is killed there just before this call. The last child is not killed.
"""

import os
import shutil
import signal
import sys
import traceback
import types
from pathlib import Path

import jaxmark

# The real package `jaxmark.files` imports JAX, and processes with JAX must not fork.
files = types.ModuleType("jaxmark.files")
files.__path__ = [str(Path(jaxmark.__file__).parent / "files")]
sys.modules["jaxmark.files"] = files

from jaxmark.files.pair import writing_pair  # noqa: E402

FILE, RECORD = Path("marked.ply"), Path("records", "marked.json")


def write(overwrite: bool, record: bytes) -> None:
    with writing_pair(FILE, RECORD, overwrite=overwrite) as pair:
        pair.file.write_bytes(b"new")
        pair.record.write_bytes(record)


def write_until(last: int, overwrite: bool, record: bytes) -> None:
    """Write the pair, and kill this process before its call to the file system of this number."""
    calls = 0

    def count(event: str, arguments: tuple) -> None:
        nonlocal calls
        if event == "open" or (event.startswith("os.") and event != "os.kill"):
            if calls == last:
                os.kill(os.getpid(), signal.SIGKILL)
            calls += 1

    sys.addaudithook(count)
    write(overwrite, record)


def main(folder: Path, overwrite: bool, record: bytes) -> None:
    assert "jax" not in sys.modules
    number, status = 0, -signal.SIGKILL
    while status == -signal.SIGKILL:
        place = folder / str(number)
        shutil.copytree(folder / "before", place)
        os.chdir(place)
        child = os.fork()
        if child == 0:
            try:
                write_until(number, overwrite, record)
                os._exit(0)
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(1)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        number += 1
    assert status == 0


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2] == "overwrite", Path(sys.argv[3]).read_bytes())
