"""`JaxmarkError`, the exception that jaxmark raises, and imports of optional dependencies."""

import importlib
import importlib.util
from pathlib import Path
from types import ModuleType


class JaxmarkError(ValueError):
    """The error for input that jaxmark refuses; the message says what is wrong, where, and how to mend it.

    The command line prints the message and ends with exit status 2.
    """


class AlignmentError(JaxmarkError):
    """The error for a suspect that cannot be aligned with the original, such as any mesh of another shape.

    The suspect can be read, but nothing is detected in it. On the command line, `detect` and `identify` end with exit
    status 1.
    """


def require(module: str, extra: str) -> ModuleType:
    """Import an optional dependency.

    Args:
        module: its dotted name.
        extra: the extra of jaxmark that installs it.

    Raises:
        JaxmarkError: if it is not installed; the message names the extra.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise JaxmarkError(f"{_missing(module, extra)} ({error})") from None


def available(module: str) -> bool:
    """Whether an optional dependency is installed, without importing it."""
    return importlib.util.find_spec(module) is not None


def package_folder(module: str, extra: str) -> Path:
    """Find the folder of an optional package without importing it.

    Raises:
        JaxmarkError: if it is not installed; the message names the extra.
    """
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        raise JaxmarkError(_missing(module, extra))
    return Path(spec.origin).parent


def _missing(module: str, extra: str) -> str:
    return f"{module.partition('.')[0]} is needed for this; install it with: pip install 'jaxmark[{extra}]'"
