"""What holds for all tests: shapes and types of every public function are checked, and compiling is cheap.

Most of the time goes into compiling what runs once: without XLA's optimisations that takes a third less.
"""

import os

from jaxtyping import install_import_hook

import tests.typecheck  # noqa: F401 (the hook looks it up by name)

os.environ["XLA_FLAGS"] = f"--xla_backend_optimization_level=0 {os.environ.get('XLA_FLAGS', '')}"
install_import_hook("jaxmark", "tests.typecheck.check")  # for as long as tests run, as rooms are imported late
