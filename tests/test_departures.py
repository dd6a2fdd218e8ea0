from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "torchrl_etdmpc"


def test_every_departure_on_the_page_is_tagged_in_its_file_and_the_other_way_round():
    table = [line for line in (ROOT / "docs" / "departures.md").read_text().splitlines() if line.startswith("|")]
    listed = [row.split("|")[-2].strip(" `") for row in table[2:]]
    tagged = [
        str(path.relative_to(PACKAGE))
        for path in PACKAGE.rglob("*.py")
        for line in path.read_text().splitlines()
        if line.strip().startswith("# Departure from")
    ]
    assert sorted(listed) == sorted(tagged)
    assert listed
