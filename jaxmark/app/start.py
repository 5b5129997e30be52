"""The command `jaxmark`, which may be interrupted while the library is still being imported."""

import sys


def main() -> None:
    """Run the command line."""
    try:
        from jaxmark.app.cli import main as run
        from jaxmark.app.programs import keep_programs

        keep_programs()
    except KeyboardInterrupt:
        sys.stderr.write("jaxmark: Interrupted.\n")
        sys.exit(2)
    run()
