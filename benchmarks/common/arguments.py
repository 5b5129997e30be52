"""Arguments that the command lines of several programs have in common."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jaxmark as jm


def make_parser(description: str | None) -> argparse.ArgumentParser:
    """A parser whose help shows the program's docstring as it is laid out."""
    return argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)


def add_meshes(parser: argparse.ArgumentParser, **options: Any) -> None:
    """Any number of mesh files, at least one by default."""
    parser.add_argument("meshes", **{"nargs": "+", "type": Path, "metavar": "MESH"} | options)


def folder_of(parser: argparse.ArgumentParser, meshes: Sequence[Path]) -> Path:
    """The folder of mesh files, whose names alone tell them apart; files of several folders end the program."""
    folders = {mesh.resolve().parent for mesh in meshes}
    if len(folders) > 1:
        parser.error("the meshes must be of one folder")
    return folders.pop()


def load(parser: argparse.ArgumentParser, path: str | Path) -> jm.Mesh:
    """Load a mesh; a file that cannot be read ends the program like any other wrong argument."""
    try:
        return jm.load_mesh(path)
    except jm.JaxmarkError as refusal:
        parser.error(str(refusal))


def positive(text: str) -> int:
    """The type of an argument that is a number of something, at least one."""
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a whole number of at least 1")
    return int(text)


def json_file(text: str) -> Path:
    """The type of an argument that names a JSON file to write, refused before hours of work rather than after."""
    path = Path(text)
    if path.suffix != ".json" or not path.parent.is_dir():
        raise argparse.ArgumentTypeError(f"{path} cannot be written: it must end in .json, in a folder that exists")
    return path
