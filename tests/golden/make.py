"""Makes marks of the present scheme version, once: python -m tests.golden.make.

The files are committed and never made anew: they stand for marks that owners have.
"""

from pathlib import Path

import numpy as np
import trimesh

import jaxmark as jm
from jaxmark.watermark.coding.keys import SCHEME_VERSION
from jaxmark.watermark.interfaces import Scheme
from jaxmark.watermark.record import RECORD_SUFFIX
from jaxmark.watermark.schemes.keyed import KeyedScheme
from jaxmark.watermark.schemes.modulated import EigenScheme, HostScheme
from tests.samples import rough_sphere

FOLDER = Path(__file__).parent / str(SCHEME_VERSION)
KEY = jm.Key(bytes(range(32)))  # for tests: everybody has it
MESSAGE = b"mark"
RECIPIENTS = ("alice", "bob")
BUDGET = 2e-3
MARKS: dict[str, Scheme] = {
    "hidden": KeyedScheme(),
    "keyed": KeyedScheme(hiding=False),
    "normals": KeyedScheme(direction="normals"),
    "narrow": KeyedScheme(passband="narrow", hiding=False),
    "host": HostScheme(),
    "eigen": EigenScheme(),
}


def save(mesh: jm.Mesh, info: jm.watermark.EmbedInfo, name: str) -> None:
    """The marked file and its record."""
    jm.save_mesh(mesh, FOLDER / f"{name}.ply", like=FOLDER / "original.ply")
    (FOLDER / f"{name}.ply{RECORD_SUFFIX}").write_text(info.record.to_json())


def main() -> None:
    """All files of this version."""
    FOLDER.mkdir()  # fails where they are there already
    shape = rough_sphere(300)
    rounded = np.asarray(shape.vertices, np.float32)
    ply = trimesh.Trimesh(rounded, shape.faces, process=False).export(file_type="ply", vertex_normal=False)
    assert isinstance(ply, bytes)
    (FOLDER / "original.ply").write_bytes(ply)
    jm.watermark.save_key(KEY, FOLDER / "test.key")
    original = jm.load_mesh(FOLDER / "original.ply")
    for name, scheme in MARKS.items():
        save(*jm.embed(original, MESSAGE, KEY, budget=jm.Budget(rms=BUDGET, noise=0), scheme=scheme), name)
    for recipient in RECIPIENTS:
        save(*jm.fingerprint(original, recipient, KEY, budget=BUDGET), recipient)


if __name__ == "__main__":
    main()
