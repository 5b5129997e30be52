"""A worker process with limits of time and memory for each call, which is replaced when it exceeds one."""

import multiprocessing
import os
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any

import jax

from jaxmark.app.folders import begin_worker
from jaxmark.errors import JaxmarkError
from jaxmark.files.unpacker import limit_memory

_SPAWN = multiprocessing.get_context("spawn")  # forks of a running JAX would hang


class Worker:
    """A process that runs one function at a time, on CPUs; it keeps what the functions cache."""

    def __init__(self, seconds: float, megabytes: int) -> None:
        """Set the limits of each call; the limit of memory is for what is added to the process, and only on Linux."""
        self._seconds, self._megabytes = seconds, megabytes
        self._process: SpawnProcess | None = None

    def begin(self) -> None:
        """Begin the process, which takes seconds in the background; otherwise, the first call begins it."""
        self._connection, other = _SPAWN.Pipe()
        process = _SPAWN.Process(target=_work, args=(other, self._megabytes * 2**20), daemon=True)
        process.start()
        self._process, self._used = process, False
        other.close()

    def end(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._connection.close()
            self._process = None

    def run(self, function: Callable[..., Any], *args: Any) -> Any:
        """Call a function at the top level of a module, and return its value, which can be pickled, as its arguments.

        If the process dies after earlier calls, which may have filled its memory, a fresh one repeats this call in the
        time that is left.

        Raises:
            JaxmarkError: if the function raises it, or exceeds a limit.
            RuntimeError: if the function raises another exception.
        """
        until = time.monotonic() + self._seconds
        if self._process is None:
            self.begin()
        while True:
            again, self._used = self._used, True
            try:
                self._connection.send((function, args))
                if not self._connection.poll(max(0.0, until - time.monotonic())):
                    raise TimeoutError
                value, error = self._connection.recv()
            except (EOFError, OSError) as error:  # TimeoutError is an OSError
                self.end()
                self.begin()
                late = isinstance(error, TimeoutError)
                if again and not late:
                    continue
                limit = f"{self._seconds:g} seconds" if late else f"{self._megabytes} megabytes of memory"
                raise JaxmarkError(
                    f"The file was not read, because that takes more than {limit}, the limit of this process; simplify"
                    " the file, or read it from the command line."
                ) from None
            if error is not None:
                raise error
            return value


def _work(connection: Connection, most_bytes: int) -> None:
    """Answer calls until the other side closes the connection."""
    begin_worker()
    jax.config.update("jax_platforms", "cpu")  # the memory of an accelerator has no limit for each process
    jax.devices()
    limit_memory(most_bytes)
    while True:
        try:
            function, args = connection.recv()
        except EOFError:
            return
        try:
            answer = function(*args), None
        except JaxmarkError as error:
            answer = None, JaxmarkError(str(error))
        except Exception as error:
            if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
                os._exit(1)  # what is left of the memory may not suffice for an answer
            answer = None, RuntimeError(f"{type(error).__name__}: {error}")
        connection.send(answer)
