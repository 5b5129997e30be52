"""`python -m jaxmark`."""

from jaxmark.cli import main

if __name__ == "__main__":
    main()
