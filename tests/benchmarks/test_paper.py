"""The benchmark of the paper's figures: every part from end to end, and what must hold on any mesh."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import trimesh

from tests import ROOT
from tests.samples import bumpy_sphere

PAPER = ROOT / "benchmarks" / "theory" / "paper.py"


def run(*options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, str(PAPER), *options], capture_output=True, text=True)


@pytest.mark.long
def test_all_figures(tmp_path: Path):
    mesh, output = tmp_path / "sphere.ply", tmp_path / "paper.json"
    trimesh.Trimesh(*bumpy_sphere(3), process=False).export(mesh)
    few = ["--trials", "1", "--repeat", "1", "--sizes", "1000", "2000", "8000", "--largest", "2000"]
    done = run(str(mesh), *few, "--output", str(output))
    assert done.returncode == 0, done.stderr
    found = json.loads(output.read_text())
    for number in (1, 2, 12, 13, 14, 15, 16):
        assert (tmp_path / f"paper-{number}.png").stat().st_size > 1000
    # Ripples of scaling functions stay, hats' fall as 1/degree, damped ones have none.
    last = found["gibbs"][0][-1]
    assert last["halved"] > 0.1 > last["hat"] * 10
    assert last["Jackson"] < 1e-6
    exponents = {row["way"]: row["exponent"] for row in reversed(found["time"][1])}
    assert exponents["dense"] > exponents["sparse"]
    by_strength = {(row["attack"], row["strength"]): row for row in found["attacks"][0]}
    still, hardest = by_strength["none", 0], by_strength["uniform", 0.03]
    for reader in ("working", "eigenvectors"):
        assert still[f"sphere, {reader}"] < 0.05 < 0.2 < hardest[f"sphere, {reader}"]
    for row in found["collinear"][0]:
        assert row["Jackson"] < 0.1 < row["printed"]


@pytest.mark.slow
@pytest.mark.parametrize("options", [["none.ply"], ["none.ply", "--trials", "0"], ["none.ply", "--output", "x.txt"]])
def test_bad_input_ends_with_status_2(options: list[str]):
    refused = run(*options)
    assert refused.returncode == 2
    assert "Traceback" not in refused.stderr
