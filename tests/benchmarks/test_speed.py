"""The benchmark of time and memory: that it measures the same work, and refuses what it cannot measure."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests import ROOT

SPEED = ROOT / "benchmarks" / "speed" / "speed.py"


def run(*options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, str(SPEED), *options], capture_output=True, text=True)


@pytest.mark.long
def test_programs_agree(tmp_path: Path):
    output = tmp_path / "speed.json"
    done = run("--sizes", "2000", "5000", "--parts", "filter", "--repeat", "1", "--output", str(output))
    assert done.returncode == 0, done.stderr
    rows = json.loads(output.read_text())["filter"]
    assert sum(row["program"] == "jaxmark filter" for row in rows) == 2
    for row in rows:
        assert "peers" in row["note"] if "note" in row else row.get("difference", 0) < 1e-4
    assert any(row["program"].startswith("SciPy") and row["difference"] < 1e-4 for row in rows)
    assert output.with_suffix(".png").stat().st_size > 1000


@pytest.mark.slow
def test_peers_agree():
    done = subprocess.run(
        [sys.executable, str(SPEED.with_name("peers.py")), "--size", "1000", "--repeat", "1"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in done.stdout.splitlines() if line[:1] == "|"]
    assert {row[1] for row in rows} >= {"jaxmark", "jaxmark moments", "matfree Lanczos", "PyG ChebConv"}
    assert all(row[2] == "not installed" or float(row[2]) > 0 for row in rows if row[0].startswith("1,0"))


@pytest.mark.long
def test_the_suite_for_devices_runs_on_processors(tmp_path: Path):
    """In small; many keys at once are as one by one, and PyTorch agrees where it is installed."""
    sizes = ("--sizes", "1000", "--mark", "1000", "--command", "1000", "--keys", "12", "--repeat", "1")
    command = [sys.executable, str(SPEED.with_name("device_suite.py")), *sizes, "--output", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "device_suite.json").read_text())
    assert found["readings"][0]["difference"] < 1e-3
    assert found["filters"][0].get("difference", 0) < 1e-4
    assert [row["command"] for row in found["commands"]] == ["embed", "detect"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [["no such mesh.ply"], ["--sizes", "10"], ["--repeat", "0"], ["--parts", "all"], ["--output", "x.txt"]]
)
def test_bad_input_ends_with_status_2(options: list[str]):
    refused = run(*options)
    assert refused.returncode == 2
    assert "Traceback" not in refused.stderr
