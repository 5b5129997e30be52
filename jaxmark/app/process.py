"""The process of a command: its end by a signal, and the compiled programs that it keeps for the next one."""

import os
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import NoReturn

import jax

_ASK_AGAIN = 5  # seconds until a process that was asked to end is asked again
_MAPS, _MOST = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
_FULL = 0.5
_FOLDER = "jaxmark"  # in the user's own folder for what may be deleted
_MAX_BYTES = 2**29
_MIN_SECONDS = 0.0  # of compiling, from which on a program is kept: the many small ones take long, too


def keep_programs() -> None:
    """Keep compiled programs for the next command on meshes of like size; compiling them takes most of its seconds.

    They lie in a folder of the user's own, since nobody else must be able to put programs there. Another folder is
    named by JAX_COMPILATION_CACHE_DIR; JAX_ENABLE_COMPILATION_CACHE=false keeps none.
    """
    allowed = jax.config.jax_enable_compilation_cache  # pyright: ignore[reportAttributeAccessIssue]
    if os.environ.get("JAX_COMPILATION_CACHE_DIR") or not allowed:
        return
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / _FOLDER
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.stat()
        if os.name == "posix" and (found.st_uid != os.getuid() or found.st_mode & 0o022):
            return
        kept = sorted(((file.stat().st_mtime, file.stat().st_size, file) for file in folder.iterdir()), reverse=True)
        size = 0
        for _, bytes_, file in kept:
            size += bytes_
            if size > _MAX_BYTES:
                file.unlink(missing_ok=True)
        if not os.access(folder, os.W_OK):
            return
    except (OSError, RuntimeError):  # no home, no room, or another command at the same work
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _MIN_SECONDS)


def release_programs() -> None:
    """Forget all compiled programs if they take half of the mappings that the system allows a process.

    Each mesh of another size needs programs of its own, and each program some mappings; beyond the limit nothing can be
    compiled any more. Only Linux has such a limit.
    """
    try:
        with _MAPS.open("rb") as maps:
            held = sum(1 for _ in maps)
        most = int(_MOST.read_text())
    except (OSError, ValueError):
        return
    if held > _FULL * most:
        jax.clear_caches()


def end_by_exception() -> None:
    """Let SIGTERM end this process as by an exception, after which no draft is left."""
    signal.signal(signal.SIGTERM, _end)


def _end(number: int, frame: FrameType | None) -> NoReturn:
    """End as by an exception.

    Python drops an exception in callbacks of its garbage collector, as JAX has one: the alarm asks again.
    """
    if hasattr(signal, "alarm"):
        signal.signal(signal.SIGALRM, _end)
        signal.alarm(_ASK_AGAIN)
    sys.exit(128 + signal.SIGTERM)
