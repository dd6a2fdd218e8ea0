from __future__ import annotations

import importlib.util
import re
import shutil
import sys
from pathlib import Path

import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("pandas")

SCRIPT = Path(__file__).resolve().parents[1] / "benchmarks" / "reproduce_tables.py"


@pytest.fixture
def script():
    spec = importlib.util.spec_from_file_location("reproduce_tables", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run(script, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *arguments])
    with pytest.raises(SystemExit) as caught:
        script.main()
    return caught.value.code


def test_every_cell_that_should_come_out_does(script, monkeypatch, capsys):
    assert run(script, monkeypatch) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert out.splitlines()[-1] == "reproduced 262 of 758 cells"
    counts = re.findall(r"^table (\S+) (\S+): (\d+) of (\d+) cells", out, re.MULTILINE)
    assert sum(int(total) for *_, total in counts) == 758
    whole = {(table, method) for table, method, good, total in counts if good == total}
    assert {(f"C.{table}", "BMPC") for table in range(1, 7)} <= whole
    assert {(f"C.{table}", method) for table in range(1, 5) for method in ("SAC", "TD-MPC2")} <= whole
    shown = re.findall(r"thesis +(\S+) +ours +(\S+)( +differs)?$", out, re.MULTILINE)
    assert sum(not differs for *_, differs in shown) == 262  # each is printed with both numbers


def test_a_disturbed_curve_is_an_error_that_names_its_cells(script, monkeypatch, capsys, tmp_path):
    reference = Path(shutil.copytree(script.REFERENCE, tmp_path / "reference"))
    tables, curves = reference / "thesis_tables.csv", reference / "bmpc.csv"
    lines = tables.read_text().splitlines(keepends=True)  # one benchmark is enough
    tables.write_text("".join(line for line in lines if line.startswith("table,") or ",dmc-hard," in line))
    text, changes = re.subn(r"(?m)^(BMPC,dog-run,300000,)([\d.]+)", r"\g<1>9\g<2>", curves.read_text())
    assert changes == 1
    curves.write_text(text)
    monkeypatch.setattr(script, "REFERENCE", reference)
    assert run(script, monkeypatch, "--summary") == 1
    out, err = capsys.readouterr()
    named = re.findall(r"^error: table (\S+) (\S+) (\S+): \S+ instead of \S+$", err, re.MULTILINE)
    assert named == [("C.3", "BMPC", "dog-run"), ("C.3", "BMPC", "aggregate")]
    assert len(err.splitlines()) == 2
    assert "table C.3 BMPC: 6 of 8 cells: SHOULD COME OUT" in out
    assert "table C.4 BMPC: 8 of 8 cells" in out
