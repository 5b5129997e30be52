"""Compiled programs, of which a process can hold only so many."""

from pathlib import Path

import jax

_MAPS, _MOST = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
_FULL = 0.5


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
