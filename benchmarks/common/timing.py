"""Seconds that calls take."""

import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar

import jax

P = ParamSpec("P")
Result = TypeVar("Result")
Call = Callable[[], object]
PATIENCE = 60.0  # seconds, after which a call is not repeated
_COMPILED = "/jax/core/compile/backend_compile_duration"  # of one program
_COMPILING = ("/jax/core/compile/jaxpr_to_mlir_module_duration", _COMPILED)


class Compilation:
    """Seconds that JAX takes to compile, without tracing, and the number of compiled programs, since it was made."""

    def __init__(self) -> None:
        self.seconds, self.programs = 0.0, 0
        jax.monitoring.register_event_duration_secs_listener(self._hear)

    def _hear(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event in _COMPILING:
            self.seconds += duration_secs
        self.programs += event == _COMPILED


def timed(call: Callable[P, Result], *args: P.args, **kwargs: P.kwargs) -> tuple[Result, float]:
    """What a call returns, and its seconds."""
    start = time.perf_counter()
    return call(*args, **kwargs), time.perf_counter() - start


def for_commands(cache: Path) -> dict[str, str]:
    """The environment of commands that keep compiled programs in a folder of their own.

    Modules that are compiled anew for each process would hide what takes long.
    """
    return {**os.environ, "PYTHONDONTWRITEBYTECODE": "", "XDG_CACHE_HOME": str(cache)}


def time_in_row(call: Call, repeat: int, *, calls: int = 20) -> float:
    """Median seconds of a call among so many that follow each other, so that a device need not wait for the host.

    Those that are not counted last a tenth of a second, because GPUs that had nothing to do are slow at first.
    """

    def in_row() -> object:
        for _ in range(calls - 1):
            call()
        return call()

    start = time.perf_counter()
    while time.perf_counter() - start < 0.1:
        jax.block_until_ready(call())
    return median_time(in_row, repeat, counted=True) / calls


def median_time(call: Call, repeat: int, *, counted: bool = False, patience: float = PATIENCE) -> float:
    """Median seconds of a call, after one that does not count unless that has been; at least one."""
    times: list[float] = []
    for turn in range(counted, repeat + 1):
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
        if turn and sum(times) > patience:
            break
    return statistics.median(times[not counted :])
