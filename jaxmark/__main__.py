"""`python -m jaxmark`."""

from jaxmark.cli import main

main()
