"""Programs of npm packages, each installed once into a folder of the user's cache."""

import os
import shutil
import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path

_CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxmark-npm"
_MOST_SECONDS = 180


class NpmError(Exception):
    """A package of npm that cannot be had, or npm itself, with the reason."""


def install(package: str) -> Path:
    """Install a package of npm, as `name@version`, with what it needs; returns the folder of its `node_modules`.

    Raises:
        NpmError: if npm or the package cannot be had.
    """
    npm, folder = shutil.which("npm"), _CACHE / package.replace("/", "-") / "node_modules"
    if npm is None or shutil.which("node") is None:
        raise NpmError("npm is not installed")
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=_CACHE) as work:
            command = [npm, "install", "--no-save", "--no-audit", "--no-fund", "--prefix", work, package]
            try:
                done = subprocess.run(command, capture_output=True, text=True, timeout=_MOST_SECONDS)
            except subprocess.TimeoutExpired:
                raise NpmError(f"npm did not install {package} within {_MOST_SECONDS} seconds") from None
            if done.returncode:
                raise NpmError(f"npm cannot install {package}: {' '.join(done.stderr.split())[:200]}")
            with suppress(OSError):  # another process has installed it meanwhile
                Path(work, "node_modules").rename(folder)
    return folder


def run_node(*words: object) -> str:
    """Run node on a script and its arguments; returns what it printed.

    Raises:
        NpmError: if it fails.
    """
    try:
        done = subprocess.run(["node", *map(str, words)], capture_output=True, text=True, timeout=_MOST_SECONDS)
    except subprocess.TimeoutExpired:
        raise NpmError(f"it took longer than {_MOST_SECONDS} seconds") from None
    if done.returncode:
        raise NpmError(" ".join((done.stderr or done.stdout).split())[-200:])
    return done.stdout
