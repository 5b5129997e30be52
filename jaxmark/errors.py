"""The one exception that jaxmark raises for input that it refuses."""


class JaxmarkError(ValueError):
    """Input that jaxmark refuses; the message says in one sentence what is wrong, where, and how to mend it.

    The command line prints the message and ends with status 2.
    """
