"""Other threads compute as this one does."""

import jax
import numpy as np
import pytest

from jaxmark.spectral.threads import in_thread


def test_precision_is_this_thread_s(dtype):
    assert in_thread(lambda: jax.device_put(np.ones(2))).result().dtype == dtype


def test_nothing_is_traced():
    @jax.jit
    def traced(x):
        return x + in_thread(lambda: float(jax.numpy.ones(2).sum())).result()

    assert traced(1.0) == 3


def test_one_follows_another_even_if_that_fails():
    order = []
    first = in_thread(lambda: order.append(1) or 1 / 0)
    in_thread(lambda: order.append(2), after=first).result()
    assert order == [1, 2]
    with pytest.raises(ZeroDivisionError):
        first.result()
