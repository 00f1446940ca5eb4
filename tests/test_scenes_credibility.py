"""Credibility page: claims with figures from records."""

import json
from pathlib import Path

import pytest

from scenes.cli import main
from scenes.report.credibility import MISSING, STATUSES, STEPS, read_credibility
from sim.errors import InputError

HOUSE = Path(__file__).parent.parent
OWN = HOUSE / "benchmarks"


def write_claims(folder: Path, result: str = "# % of #", figures: str = '["one > a > x", "one > a > y"]') -> Path:
    (folder / "records").mkdir()
    record = {"command": "run", "machine": "here", "date": "2026-01-01", "figures": {"a": {"x": 3.5, "y": "4"}}}
    (folder / "records" / "one.json").write_text(json.dumps(record))
    claims = [f'[[claim]]\nstep = "{step}"\nclaim = "it <holds>"\n' for step in STEPS]
    claims[3] += f'result = "{result}"\nfigures = {figures}\ntests = ["tests/test_it.py"]\n'
    (folder / "credibility.toml").write_text("\n".join(claims))
    return folder


def test_figures_of_records_fill_the_result_of_a_claim(tmp_path, capsys):
    rows = read_credibility(write_claims(tmp_path))
    assert [row.step for row in rows] == list(STEPS)
    assert rows[3].result == "3.5 % of 4" and rows[3].tests == "tests/test_it.py"
    assert rows[3].records == "run, 2026-01-01; machine: here" and rows[3].status == "not judged"
    assert rows[0].status == MISSING
    assert main(["report", "--credibility", str(tmp_path), "--out", str(tmp_path / "out"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["missing"] == len(STEPS) - 1
    page = (tmp_path / "out" / "index.html").read_text()
    assert (
        page.count("<h2>") == len(STEPS) + 1
        and f"{len(STEPS)} claims: 0 supported, " in page
        and "it &lt;holds&gt;" in page
    )


def test_claims_of_the_project_name_existing_tests_and_figures():
    rows = read_credibility(OWN)
    named = {part for row in rows for part in row.tests.split("; ") if part}
    assert named and all((HOUSE / name).is_file() for name in named)
    assert all(row.fails_if or row.status in ("not judged", MISSING) for row in rows)
    assert {row.status for row in rows} == set(STATUSES)


@pytest.mark.parametrize(
    ("result", "figures", "words"),
    [
        ("#", "[]", "another number of #"),
        ("#", '["two > a > x"]', "'two > a > x' is not a figure"),
        ("#", '["one > b > x"]', "'one > b > x' is not a figure"),
        ("#", '["one"]', "'one' is not a figure"),
    ],
)
def test_claim_without_its_figure_is_rejected(tmp_path, result, figures, words):
    with pytest.raises(InputError, match=words):
        read_credibility(write_claims(tmp_path, result, figures))


def test_options_of_loads_are_rejected(tmp_path, capsys):
    folder = str(write_claims(tmp_path))
    for words in (["--quick"], ["--tissue", folder]):
        assert main(["report", "--credibility", folder, "--out", str(tmp_path / "out"), *words]) == 2
        assert "solves no loads" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_claim_with_unknown_status_is_rejected(tmp_path):
    folder = write_claims(tmp_path)
    (folder / "credibility.toml").write_text((folder / "credibility.toml").read_text() + 'status = "proven"\n')
    with pytest.raises(InputError, match="unknown step or status"):
        read_credibility(folder)


def test_step_without_claim_is_rejected(tmp_path):
    folder = write_claims(tmp_path)
    text = (folder / "credibility.toml").read_text()
    (folder / "credibility.toml").write_text(text.replace("validation", "verification"))
    with pytest.raises(InputError, match="no claim for validation"):
        read_credibility(folder)
