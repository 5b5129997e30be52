"""The pictures in documents, with hashes of the pictures and of their sources.

`docs/pictures/drawn.json` has a hash of each picture and of the files that draw it; `tests/project/test_pictures.py`
compares them. If the measurement in a picture is not part of the project, the picture alone is compared.
"""

import hashlib
import io
import json
from pathlib import Path

from jaxmark.files.atomic import write_atomically

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "pictures"
DRAWN = FOLDER / "drawn.json"
MOST_BYTES = 150_000
COLOURS = 128


def small(png: bytes, width: int) -> bytes:
    """A picture at most so wide, in few colours."""
    from PIL import Image  # comes with the extra `plot`

    image = Image.open(io.BytesIO(png)).convert("RGB")
    if image.width > width:
        image = image.resize((width, round(image.height * width / image.width)), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    image.quantize(COLOURS).save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()


def sources(picture: str) -> list[Path]:
    """Return the files that draw a picture: a program of pictures, and the notebook or packages that draw for it."""
    programs, package = ROOT / "benchmarks" / "pictures", ROOT / "jaxmark"
    if picture == "growth.png":
        return []
    if picture.startswith("visibility_"):
        found = {programs / "looks.py", package / "plot" / "reflections.py", package / "geometry" / "raster.py"}
    elif picture.startswith("gallery_"):
        notebooks = (ROOT / "notebooks").glob(f"{picture.removeprefix('gallery_')[:2]}_*.py")
        found = {*notebooks, programs / "front.py"}
    elif picture == "methods.png":
        found = {ROOT / "docs" / "results" / "benchmark.csv", package / "plot" / "figures.py", programs / "front.py"}
    else:
        found = {*(package / "plot").glob("*.py"), programs / "front.py"}
    return sorted({*found, Path(__file__).resolve()})


def hashes(picture: str) -> dict[str, str]:
    """Hashes of a picture and of its sources."""
    digest = hashlib.sha256()
    for path in sources(picture):
        digest.update(hashlib.sha256(path.relative_to(ROOT).as_posix().encode() + b"\0" + path.read_bytes()).digest())
    path = FOLDER / picture
    drawn = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
    return {"picture": drawn, "sources": digest.hexdigest()}


def known() -> dict[str, dict[str, str]]:
    """The hashes of all pictures when they were drawn."""
    return json.loads(DRAWN.read_text()) if DRAWN.is_file() else {}


def keep(path: Path, png: bytes) -> None:
    """Write a picture, and note by what it was drawn if it is one of the documents'."""
    write_atomically(path, png)
    if path.resolve().parent == FOLDER:
        now = known() | {path.name: hashes(path.name)}
        there = {name: now[name] for name in sorted(now) if (FOLDER / name).is_file()}
        write_atomically(DRAWN, (json.dumps(there, indent=2) + "\n").encode())
