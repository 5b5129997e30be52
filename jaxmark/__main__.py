"""`python -m jaxmark`."""

from jaxmark.app.cli import main

if __name__ == "__main__":
    main()
