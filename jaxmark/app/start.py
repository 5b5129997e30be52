"""The command `jaxmark`, which may be interrupted while the library is still being imported."""

import os
import sys


def main() -> None:
    """Run the command line."""
    # OpenBLAS's threads cost more than they save: NumPy is asked for many small things here, and few large ones.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        from jaxmark.app.cli import main as run
        from jaxmark.app.process import keep_programs

        keep_programs()
    except KeyboardInterrupt:
        sys.stderr.write("jaxmark: Interrupted.\n")
        sys.exit(2)
    run()
