"""Compiled programs: their cache on disk, and their release in processes that use many."""

import os
from pathlib import Path

import jax

_MAPS, _MOST = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
_FULL = 0.5  # fraction of the allowed mappings above which compiled programs are released
_FOLDER = "jaxmark"  # name of the cache's folder in the user's cache folder
_MAX_BYTES = 2**29  # largest size of the cache
_MIN_SECONDS = 0.0  # least compile time of cached programs; small programs are cached, too, because there are many


def keep_programs() -> None:
    """Cache compiled programs on disk, for this process and later ones on meshes of similar size.

    Compiling takes most of the time of a first call. The command line caches programs, too, in the same folder,
    `~/.cache/jaxmark`, or `jaxmark` in the folder that XDG_CACHE_HOME names. Only the user can write to it, so that no
    other user can put programs there; a folder that others can write to is not used. It holds at most 512 MB: each call
    removes the oldest files beyond that. JAX_COMPILATION_CACHE_DIR sets another folder, which is left to JAX;
    JAX_ENABLE_COMPILATION_CACHE=false turns the cache off.
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
    except (OSError, RuntimeError):  # no home folder, no space left, or another process changes the cache
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
