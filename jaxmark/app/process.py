"""The process of a command: how it ends by a signal, and the cache of compiled programs."""

import os
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import NoReturn

import jax

_ASK_AGAIN = 5  # seconds after which a process that was asked to end is asked again
_MAPS, _MOST = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
_FULL = 0.5  # fraction of the allowed mappings above which compiled programs are released
_FOLDER = "jaxmark"  # name of the cache's folder in the user's cache folder
_MAX_BYTES = 2**29  # largest size of the cache
_MIN_SECONDS = 0.0  # least compile time of cached programs; small programs are cached, too, because there are many


def keep_programs() -> None:
    """Cache compiled programs on disk for later commands on meshes of similar size.

    Compiling takes most of the time of a command. The cache is a folder that only the user can write, so that no other
    user can put programs there. JAX_COMPILATION_CACHE_DIR sets another folder; JAX_ENABLE_COMPILATION_CACHE=false turns
    the cache off.
    """
    allowed = jax.config.jax_enable_compilation_cache  # pyright: ignore[reportAttributeAccessIssue]
    if os.environ.get("JAX_COMPILATION_CACHE_DIR") or not allowed:
        return
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / _FOLDER
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
        if os.name == "posix" and (status.st_uid != os.getuid() or status.st_mode & 0o022):
            return
        newest_first = ((file.stat().st_mtime, file.stat().st_size, file) for file in folder.iterdir())
        size = 0
        for _, bytes_, file in sorted(newest_first, reverse=True):
            size += bytes_
            if size > _MAX_BYTES:
                file.unlink(missing_ok=True)
        if not os.access(folder, os.W_OK):
            return
    except (OSError, RuntimeError):  # no home folder, no space left, or another command changes the cache
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _MIN_SECONDS)


def release_programs() -> None:
    """Release all compiled programs if they use half of the memory mappings that the system allows a process.

    Each new mesh size needs its own programs, and each program needs some mappings. If a process has no mappings left,
    nothing can be compiled. Only Linux has such a limit.
    """
    try:
        with _MAPS.open("rb") as maps:
            mappings = sum(1 for _ in maps)
        most = int(_MOST.read_text())
    except (OSError, ValueError):
        return
    if mappings > _FULL * most:
        jax.clear_caches()


def end_by_exception() -> None:
    """Let SIGTERM end this process by an exception, so that unfinished output files are removed."""
    signal.signal(signal.SIGTERM, _end)


def _end(number: int, frame: FrameType | None) -> NoReturn:
    """Raise SystemExit, and again after some seconds if the process is still running.

    Python discards exceptions in callbacks of its garbage collector, and JAX has such a callback.
    """
    if hasattr(signal, "alarm"):
        signal.signal(signal.SIGALRM, _end)
        signal.alarm(_ASK_AGAIN)
    sys.exit(128 + signal.SIGTERM)
