"""Attacks that run on the host: in NumPy, or in other programs."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec

from jaxmark.geometry.mesh import Mesh, check_concrete

Arguments = ParamSpec("Arguments")


def on_host(attack: Callable[Arguments, Mesh]) -> Callable[Arguments, Mesh]:
    """Let an attack refuse, by its name, to be traced."""

    @wraps(attack)
    def checked(*arguments: Arguments.args, **options: Arguments.kwargs) -> Mesh:
        values = [*arguments, *options.values()]
        meshes = [value for value in values if isinstance(value, Mesh)]
        check_concrete(attack.__name__, *values, *(leaf for mesh in meshes for leaf in mesh))
        return attack(*arguments, **options)

    return checked
