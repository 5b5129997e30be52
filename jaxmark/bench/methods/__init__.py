"""The methods that take part by name; each is loaded when it is asked for."""

import importlib
from collections.abc import Mapping
from dataclasses import replace

from jaxmark.bench.method import Method
from jaxmark.errors import JaxmarkError

_FOLDER = "jaxmark.bench.methods"
#: Where each method is made of the size of its message: a module of this folder, and a function in it.
METHODS: Mapping[str, str] = {
    "keyed": "library:keyed",
    "eigen": "library:eigen",
    "host": "library:host",
    "paper": "library:paper",
    "field": "library:field",
    "local": "library:local",
    "harmonics": "library:harmonics",
    "cho": "cho:cho",
    "cho-variance": "cho:cho_variance",
    "radial": "radial:radial",
    "wang": "moments:moments",
    "praun": "influence:influence",
}


def get_method(name: str, bits: int) -> Method:
    """Make a method by its name in `METHODS`, for messages of so many bits.

    Raises:
        JaxmarkError: if there is none of that name.
    """
    if name not in METHODS:
        raise JaxmarkError(f"There is no method {name!r}; there are {', '.join(METHODS)}, and files of your own.")
    module, _, function = METHODS[name].partition(":")
    made = getattr(importlib.import_module(f"{_FOLDER}.{module}"), function)(bits)
    return replace(made, name=name)
