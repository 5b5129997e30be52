"""Marks that earlier versions made are read by this one, from the files that owners have; see tests/golden/make.py."""

import math

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.coding.keys import SCHEME_VERSION
from jaxmark.watermark.record import RECORD_SUFFIX
from tests import ROOT
from tests.golden.make import MARKS, MESSAGE, RECIPIENTS

pytestmark = pytest.mark.core

GOLDEN = ROOT / "tests" / "golden"
VERSIONS = sorted(folder.name for folder in GOLDEN.iterdir() if folder.name.isdigit())

SLOW = ("normals", "narrow")  # compiled for themselves


def marks_of(version: str) -> list[str]:
    """Names of the marks that a version has."""
    return [name for name in MARKS if (GOLDEN / version / f"{name}.ply").exists()]


def files(version: str, name: str) -> tuple[Mesh, Mesh, jm.Key, jm.Record]:
    """A marked mesh, its original, key and record."""
    folder = GOLDEN / version
    return (
        jm.load_mesh(folder / f"{name}.ply"),
        jm.load_mesh(folder / "original.ply"),
        jm.watermark.load_key(folder / "test.key"),
        jm.Record.load(folder / f"{name}.ply{RECORD_SUFFIX}"),
    )


def test_there_are_files_of_this_version():
    assert str(SCHEME_VERSION) in VERSIONS


@pytest.mark.parametrize(
    ("version", "name"),
    [
        pytest.param(version, name, marks=pytest.mark.slow if name in SLOW else ())
        for version in VERSIONS
        for name in marks_of(version)
    ],
)
def test_old_marks_are_read_to_the_exact_message(version: str, name: str):
    suspect, original, key, record = files(version, name)
    found = jm.detect(suspect, original=original, key=key, record=record)
    assert found.message == MESSAGE
    assert found.detected()


@pytest.mark.parametrize("version", VERSIONS)
def test_old_fingerprints_accuse_their_recipients(version: str):
    copies = [files(version, name) for name in RECIPIENTS]
    _, original, key, record = copies[0]
    tracer = jm.watermark.make_tracer(original, key, record=record)
    for (suspect, *_), recipient in zip(copies, RECIPIENTS, strict=True):
        first, second = tracer.identify(suspect, [*RECIPIENTS, "nobody"], top=2)
        assert first.recipient == recipient
        assert first.log10_p < -6 < math.log10(0.05) < second.log10_p


@pytest.mark.parametrize("version", VERSIONS)
def test_the_files_are_marked(version: str):
    """None is the original, and no two are alike: what is read is in them."""
    meshes = [files(version, name)[0].vertices for name in (*marks_of(version), *RECIPIENTS)]
    meshes.append(files(version, "keyed")[1].vertices)
    for place, one in enumerate(meshes):
        assert all(np.abs(one - other).max() > 1e-4 for other in meshes[:place])
