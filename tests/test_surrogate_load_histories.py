"""Histories of loads in relaxing tissue, and finite elements of the same relaxed share."""

import numpy as np
import pytest
from test_surrogate_relaxation import BALL, EFFECTS, SERIES, played, pressed

from scenes.builtin.retract import RELAXING_BRAIN
from scenes.cli import main
from sim.bodies.meshfile import write_anatomy
from sim.fem import Fem
from sim.loads import Loads
from sim.tools import Capsule
from surrogate.data.dataset import read_dataset
from surrogate.data.load_histories import (
    APPROACH_TIME,
    compute_decayed_coefficients,
    read_prony_series,
    sample_times,
    solve_histories,
)
from surrogate.data.tool_poses import draw_poses
from surrogate.model.relaxation import update_relaxation


def test_single_step_history_equals_two_played_steps():
    for time in (0.0, 0.2, APPROACH_TIME, 3.0, 80.0):
        alone = update_relaxation(SERIES, pressed(2e-3), np.array([time]), None, 1e-4)
        steps = [t for t in (min(time, APPROACH_TIME), time) if t > 0.0]
        np.testing.assert_allclose(
            alone.relaxed_share, played([2e-3] * len(steps), steps)[-1].relaxed_share if steps else 0.0
        )
        assert alone.relaxed_share[0] == pytest.approx(
            0.7 - compute_decayed_coefficients(SERIES, np.array([time])).sum()
        )


def test_fem_response_depends_only_on_the_relaxed_share(box):
    """A slow approach and a held tool with equal shares give equal motion and force."""
    fem = Fem(box, list(EFFECTS), device="cpu", batch=1, element="p1")
    causes = draw_poses("palpation", box, 1, 5, BALL).causes
    slow = solve_histories(fem, Loads(causes, np.array([2.0])))
    gone = compute_decayed_coefficients(SERIES, np.array([2.0])).sum()
    low, high = APPROACH_TIME, 60.0
    for _ in range(60):  # one step of so long
        middle = 0.5 * (low + high)
        left = sum(g * np.exp(-middle / (2.0 * tau)) for g, tau in SERIES)
        low, high = (middle, high) if left > gone else (low, middle)
    fast, elastic = (fem.deform(Loads(causes, np.array([time]))) for time in (low, 0.0))
    assert slow.time[0] == 2.0 and slow.outcome[0].good
    size = np.abs(slow.displacement).max()
    np.testing.assert_allclose(slow.displacement, fast.displacement, atol=2e-3 * size)
    np.testing.assert_allclose(slow.reaction[0, 0, :3], fast.reaction[0, 0, :3], atol=5e-4)
    assert np.linalg.norm(slow.reaction[0, 0, :3]) < 0.8 * np.linalg.norm(elastic.reaction[0, 0, :3])


def test_simulate_draws_times_for_relaxing_tissue(tmp_path, box, capsys):
    mesh, out = tmp_path / "box.vtu", tmp_path / "data.h5"
    write_anatomy(mesh, box)
    wanted = ["simulate", str(mesh), "--out", str(out), "--pose-control", "--count", "2", "--json"]
    wanted += ["--preset", "dissector", "--capsule", "2", "26"]
    assert main([*wanted, "--element", "p1", "--prony", "0.45,0.5;0.365,50"]) == 0
    found = read_dataset(out)
    assert read_prony_series(found.provenance) == RELAXING_BRAIN.prony
    np.testing.assert_array_equal(found.loads.times, sample_times(2, 0))
    assert found.good.all() and found.tool == Capsule(2e-3, 0.026)
    assert main([*wanted, "--prony", "0.45;50", "--force"]) == 2
    assert '--prony 0.45;50: write pairs G,TAU with ; between, as in "0.45,0.5;0.365,50"' in capsys.readouterr().err
