"""Compiled filters for processors, which jaxmark finds where this is installed; see its `jaxmark.spectral.kernels`."""

from jaxmark_kernels import _targets

#: Targets of JAX's foreign function interface by name: what is computed, and the dtype.
TARGETS = {name: getattr(_targets, name) for name in dir(_targets) if name.endswith(("float32", "float64"))}
