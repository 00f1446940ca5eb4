"""List of figures: commands parse, numbers exist in the results, and pages name no other benchmark."""

import re
from dataclasses import fields
from pathlib import Path

import pytest
from conftest import make_box

from benchmarks.__main__ import BENCHMARKS, make_parser
from benchmarks.figures.figure_readings import LIVE, STAGES
from benchmarks.figures.figures import FIGURES, NAMED, SHORTCUTS, build_arguments
from benchmarks.peers import comparison as peers
from benchmarks.studies import elements, frame, live, robustness, scaling, shortcuts, skull_models, stages, throughput
from scenes.script.craniotomy_frame import build_craniotomy_frame
from surrogate.data.tool_loads import PRESETS

HOUSE = Path(__file__).parents[1]
ROWS = {
    "throughput": throughput.ThroughputRow,
    "live": live.RideStatistics,
    "stages": stages.StageRow,
    "frame": frame.StageTime,
    "shortcuts": shortcuts.ShortcutRow,
    "growth": scaling.ScalingRow,
    "solver": peers.EngineRow,
    "robust": robustness.SetStatistics,
    "skull": skull_models.SkullRow,
    "elements": elements.ElementRow,
}
"""What each bench has in the lists of its JSON."""


@pytest.mark.parametrize("name", NAMED)
def test_every_figure_command_parses(name):
    figure = NAMED[name]
    parser = make_parser(figure.command.split()[0])
    for quick in (False, True):
        for anatomy in (None, "brain.vtu"):
            args = parser.parse_args([*build_arguments(figure, quick, anatomy), "--json"])
            given = next((getattr(args, key) for key in ("anatomy", "anatomies", "mesh") if hasattr(args, key)), None)
            assert args.device == figure.device and args.json
            taken = anatomy is not None and figure.anatomy_option is not None
            assert bool(given) == taken and (not taken or "brain.vtu" in str(given))


def test_every_figure_number_is_a_field_of_its_bench():
    """Numbers read from results are fields of these results."""
    for figure in FIGURES:
        row = ROWS[figure.command.split()[0]]
        known = {field.name for field in fields(row)} | {
            key for key, it in vars(row).items() if isinstance(it, property)
        }
        for reading in figure.readings:
            if isinstance(reading.place[-2] if len(reading.place) > 1 else None, dict):
                assert {reading.place[-1], *reading.place[-2]} <= known, f"{figure.name}: {reading.name}"
    assert {it.place[1]["ride"] for it in LIVE} == {ride.name for ride in live.RIDES}
    text = Path(stages.__file__).read_text()
    assert all(f'"{it.place[1]["name"]}"' in text for it in STAGES)
    presets = [step["preset"] for it in FIGURES for r in it.readings for step in r.place if "preset" in str(step)]
    assert presets and set(presets) <= {*PRESETS, *robustness.SETS}
    stated = [step for it in FIGURES for r in it.readings for step in r.place if "shortcut" in str(step)]
    done = [
        {"shortcut": work.shortcut, "work": work.name}
        for work in shortcuts.list_cases(build_craniotomy_frame(make_box()), 1, False)
    ]
    assert len(stated) == 2 * len(SHORTCUTS) + 2 and not [pair for pair in stated if pair not in done]


def test_every_documented_benchmark_has_a_recorded_value():
    measured = {figure.command.split()[0] for figure in FIGURES}
    stated = set()
    for name in ("figures.md", "solver_speed.md"):
        text = re.sub(r"<!-- bench.*?<!-- end -->", "", (HOUSE / "docs/notes" / name).read_text(), flags=re.DOTALL)
        stated |= {*re.findall(r"`(?:\w+=\w+ )?python -m benchmarks\s+(\w+)", text)} & set(BENCHMARKS)
    assert len(stated) > 8 and stated - {"all"} <= measured
    assert len({figure.name for figure in FIGURES}) == len(FIGURES)
