"""Run the command line by `python -m jaxmark`."""

from jaxmark.app.start import main

if __name__ == "__main__":
    main()
