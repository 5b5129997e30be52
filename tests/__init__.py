"""What holds for all tests: shapes and types of every public function are checked, and compiling is cheap.

Most of the time goes into compiling what runs once: without XLA's optimisations that takes a third of the time.
"""

import os
from importlib.metadata import version
from pathlib import Path

from jaxtyping import install_import_hook

import tests.typecheck  # noqa: F401 (the hook looks it up by name)

ROOT = Path(__file__).parents[1]  # of the checkout
FLAGS = ["--xla_backend_optimization_level=0", "--xla_cpu_parallel_codegen_split_count=1"]
if version("jaxlib").startswith("0.10."):  # XLA ends the process for a flag it does not know
    FLAGS.append("--xla_cpu_use_fusion_emitters=false")
os.environ["XLA_FLAGS"] = " ".join([*FLAGS, os.environ.get("XLA_FLAGS", "")])
install_import_hook("jaxmark", "tests.typecheck.check")  # for as long as tests run, as subpackages are imported late
