"""The entry point of the command `jaxmark`; it handles Ctrl+C while the library is still being imported."""

import os
import sys


def main() -> None:
    """Run the command line."""
    # The threads of OpenBLAS cost more time than they save, because most NumPy operations here are small.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        from jaxmark.app.cli import main as run
        from jaxmark.files.programs import keep_programs

        keep_programs()
    except KeyboardInterrupt:
        sys.stderr.write("jaxmark: Interrupted.\n")
        sys.exit(2)
    run()
