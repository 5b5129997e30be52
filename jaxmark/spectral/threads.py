"""Computing in other threads, where JAX traces nothing."""

from collections.abc import Callable
from concurrent.futures import Future, wait
from threading import Thread
from typing import TypeVar

import jax

Result = TypeVar("Result")


def in_thread(compute: Callable[[], Result], after: "Future[object] | None" = None) -> "Future[Result]":
    """Compute in another thread, where nothing is traced; in this one, if the interpreter is shutting down.

    Args:
        compute: the function, which finds JAX with this thread's precision and default device.
        after: another computation, which ends first.
    """
    future: Future[Result] = Future()
    wide = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]

    def run() -> None:
        try:
            if after is not None:
                wait([after])
            with jax.enable_x64(wide), jax.default_device(device):
                future.set_result(compute())
        except BaseException as error:
            future.set_exception(error)

    try:
        Thread(target=run).start()
    except RuntimeError:
        with jax.ensure_compile_time_eval():
            run()
    return future
