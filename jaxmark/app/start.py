"""The entry point of the command `jaxmark`; it handles Ctrl+C while the library is still being imported."""

import ctypes
import os
import sys

_ARENA_MAX = -8  # parameter of glibc's `mallopt`: the largest number of heaps


def main() -> None:
    """Run the command line."""
    # The threads of OpenBLAS cost more time than they save, because most NumPy operations here are small.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _share_heaps()
    try:
        from jaxmark.app.cli import main as run
        from jaxmark.files.programs import keep_programs

        keep_programs()
    except KeyboardInterrupt:
        sys.stderr.write("jaxmark: Interrupted.\n")
        sys.exit(2)
    run()


def _share_heaps() -> None:
    """Have no more heaps than processors, where the C library is glibc.

    By default, it has eight for each processor. Threads of one heap have no use of what was freed in another, which
    takes a sixth of the memory.
    """
    set_option = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if set_option is not None:
        set_option(_ARENA_MAX, os.cpu_count() or 1)
