"""Synthetic test cases (twins) for `locate`: rival estimators, statistics and stored cases."""

import json
from dataclasses import replace

import numpy as np
import pytest
from locators import in_a_skull
from scipy.spatial.transform import Rotation

from benchmarks.__main__ import main
from benchmarks.studies import locate_rivals as baselines
from benchmarks.studies import locate_twins
from benchmarks.studies.locate_study import (
    ORACLE,
    OURS,
    Estimate,
    PointModel,
    add_errors,
    build_point_models,
    compare_motion,
    evaluate_locator,
    measure_baselines,
    sample_observation,
    summarise_estimates,
)
from benchmarks.studies.locate_twins import SyntheticCase, sample_parameters, solve_cases
from sim.accuracy import REFERENCE
from sim.bodies.meshfile import write_anatomy
from sim.bodies.open_cortex import open_cortex
from sim.bodies.refine import refine
from sim.effects import Bonded, Elasticity, Held, NodalForce
from sim.errors import InputError
from sim.families.geometric import compute_kelvinlets
from sim.fem import Fem
from sim.loads import Loads, Nodal, Posture, Pushed
from sim.material import Material
from surrogate.locating import locator_store
from surrogate.locating.locator import Locator
from surrogate.locating.prior import NO_PLACE, MotionPrior, compute_centroid_motion


@pytest.fixture(scope="module")
def body():
    return in_a_skull()


@pytest.fixture(scope="module")
def tumour(body):
    return body.mesh.nodes[body.tumour_nodes]


@pytest.fixture(scope="module")
def locator(body):
    """Smooth shapes of every cause in every skull, and of a tool that presses on one of two places."""
    labels = [(kind, skull, NO_PLACE) for kind in (1, 2, 3) for skull in (0, 1, 2) for _ in range(2)]
    labels += [(0, skull, place) for skull in (0, 1) for place in (NO_PLACE, 0, 1) for _ in range(3)]
    random, nodes = np.random.default_rng(0), body.mesh.nodes
    source = random.choice(nodes[np.unique(body.open_surface)], len(labels)) - random.uniform(
        0.0, 0.02, (len(labels), 3)
    )
    force = random.standard_normal((len(labels), 3))
    shape = np.einsum("nivj,ni->nvj", compute_kelvinlets(nodes, source, 25e-3, 0.49), force)
    shape *= 1e-3 / np.sqrt((shape**2).sum(axis=2).mean(axis=1))[:, None, None]
    prior = MotionPrior(body, shape.astype(np.float32), *np.array(labels).T, centre=np.zeros((2, 3)))
    return Locator(prior, np.tile([[0.0, 3.0, -20.0, 0.0, 3.0], [3.0, 6.0, -10.0, 0.0, 3.0]], (20, 1)))


def some_motion(locator, number):
    """A motion (V, 3) of 3 mm by two of its shapes."""
    pair = locator.prior.shape[[number % 6, 18 + number % 3]].astype(float)
    return 3.0 * np.tensordot([0.8, 0.6], pair, 1)


def scatter_columns(count, seed=0):
    return np.random.default_rng(seed).uniform(0.0, 0.08, (count, 3))


def test_rigid_estimator_recovers_a_rigid_motion(tumour):
    rest = scatter_columns(30)
    turn = Rotation.from_rotvec([0.02, -0.05, 0.03])

    def motion(at):
        return turn.apply(at) + [1e-3, 2e-3, -3e-3] - at

    assert baselines.fit_rigid_motion(tumour)(rest, motion(rest)) == pytest.approx(motion(tumour), abs=1e-12)


def test_thin_plates_extrapolate_linearly_and_smooth_noise(tumour):
    rest = scatter_columns(40)

    def motion(at):
        return at @ (0.05 * np.arange(9.0).reshape(3, 3) - 0.2) + [1e-3, 0.0, -2e-3]

    assert baselines.fit_thin_plates(tumour)(rest, motion(rest)) == pytest.approx(motion(tumour), abs=1e-9)
    noise = 1e-3 * np.random.default_rng(1).standard_normal(rest.shape)
    smooth = baselines.fit_thin_plates(rest)(rest, motion(rest) + noise)
    assert np.linalg.norm(smooth - motion(rest)) < 0.6 * np.linalg.norm(noise)
    wavy = 5e-3 * np.sin(40.0 * rest)  # what is no noise is kept
    assert baselines.fit_thin_plates(rest)(rest, wavy) == pytest.approx(wavy, abs=1e-4)


def test_kelvinlets_equal_kelvin_solution_and_are_symmetric():
    """Kelvin 1848: u = (1 / r) ((3 - 4 nu) I + r r^T / r^2) f / (16 pi mu (1 - nu)), times 4 pi mu."""
    nu, arm = 0.49, np.array([0.3, -0.2, 0.4])
    found = compute_kelvinlets(arm[None], np.zeros((1, 3)), 1e-4, nu)[0, :, 0]
    length = np.linalg.norm(arm)
    kelvin = ((3.0 - 4.0 * nu) * np.eye(3) + np.outer(arm, arm) / length**2) / (4.0 * (1.0 - nu) * length)
    assert found == pytest.approx(kelvin, rel=1e-5)
    points = np.random.default_rng(0).uniform(size=(5, 3))
    whole = compute_kelvinlets(points, points, 10e-3, nu).reshape(15, 15)
    assert whole == pytest.approx(whole.T) and np.linalg.eigvalsh(whole).min() > 0.0


def test_kelvinlet_estimator_recovers_point_forces(tumour):
    """Recovered except for the ridge term; forces differ along each axis, which detects swapped axes."""
    rest = scatter_columns(12)
    force = np.random.default_rng(2).standard_normal((12, 3)) * [1e-5, 2e-5, 3e-5]
    seen, there = (np.einsum("nivj,ni->vj", compute_kelvinlets(at, rest, 10e-3, 0.49), force) for at in (rest, tumour))
    found = baselines.fit_kelvinlets(tumour)(rest, seen)
    assert np.linalg.norm(found - there) < 0.05 * np.linalg.norm(there)
    twice, torn = np.concatenate([rest, rest[:1] + 1e-9]), np.zeros((13, 3))
    torn[[0, 12]] = [[1e-3, 0.0, 0.0], [-1e-3, 0.0, 0.0]]  # two points in one place that part
    assert np.abs(baselines.fit_kelvinlets(tumour)(twice, torn)).max() < 1e-3


def test_spring_estimator_depends_on_skull_stiffness(body):
    motion = np.cross([0.02, 0.01, -0.03], body.mesh.nodes - body.mesh.nodes.mean(axis=0)) + [1e-3, 2e-3, -3e-3]
    seen, true = sample_observation(body, motion, PointModel(40, 60, 0), (0,)), motion[body.tumour_nodes]
    found = baselines.build_spring_body(body, skull_stiffness=1.0, point_stiffness=100.0)(
        seen.rest, seen.now - seen.rest
    )
    assert found == pytest.approx(true, abs=1e-5)
    held = baselines.build_spring_body(body, skull_stiffness=1e9, point_stiffness=100.0)(
        seen.rest, seen.now - seen.rest
    )
    assert 0.05 < np.linalg.norm(held, axis=1).mean() / np.linalg.norm(true, axis=1).mean() < 0.9


def test_stiff_spring_compliance_matches_bonded_fem(body):
    """Reference: finite elements of linear tissue with a force at one vertex."""
    cortex = np.unique(body.open_surface)
    force = np.zeros((1, len(body.mesh.nodes), 3))
    force[0, cortex[7]] = [0.0, 0.02, -0.01]
    stiff = [Material("linear", 3000.0 * times, 0.45) for times in (1.0, 2.0)]
    effects = (Elasticity(stiff[0], {2: stiff[1]}), Held(), Bonded(), NodalForce())
    true = Fem(body, effects, REFERENCE, "cpu", element="p1").deform(Loads((Nodal(force),)))
    found = np.tensordot(force[0, cortex[7]], baselines.build_spring_body(body, skull_stiffness=1e11).compliance[7], 1)
    assert found == pytest.approx(true.displacement[0, np.append(cortex, body.tumour_nodes)], rel=1e-3, abs=1e-8)


def test_oracle_reproduces_motions_of_its_shapes(locator, body):
    motion = some_motion(locator, 1)
    assert baselines.fit_oracle(locator.prior, motion) == pytest.approx(motion[body.tumour_nodes], abs=1e-7)
    other = np.where(np.arange(len(motion))[:, None] % 2, 1e-3, -1e-3) * np.ones(3)
    off = baselines.fit_oracle(locator.prior, other) - other[body.tumour_nodes]
    assert 0.1e-3 < np.linalg.norm(off, axis=1).mean() < 2e-3


def test_row_statistics_match_hand_calculation():
    zeros = np.zeros((3, 3))
    true = 1e-3 * np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 2.0], [3.0, 0.0, 0.0]])
    exact = compare_motion(true, true, 7.8, 0.010)
    half = compare_motion(true - [0.0, 1e-3, 0.0], true, 7.9, 0.030)
    refused = compare_motion(zeros, true, None, None, is_rejected=True)
    assert half.error == pytest.approx(np.full(3, 1e-3)) and half.motion == pytest.approx([5e-3, 2e-3, 3e-3])
    found = summarise_estimates(PointModel(30, 20, 1), "it", [exact, half])
    assert (found.points, found.cover, found.noise, found.estimator) == (30, 20, 1, "it")
    assert found.removed == pytest.approx(100.0 * (1.0 - 3.0 / 20.0)) and found.mean == pytest.approx(0.5)
    assert (found.held, found.milliseconds) == (50.0, pytest.approx(20.0)) and (found.twins, found.refused) == (2, 0)
    with_refused = summarise_estimates(PointModel(30, 20, 1), "it", [exact, half, refused])
    assert with_refused.removed == pytest.approx(100.0 * (1.0 - 13.0 / 30.0)) and with_refused.held == 50.0
    warned = summarise_estimates(
        PointModel(30, 20, 1), "it", [replace(half, has_warning=True), half, replace(half, has_slip=True)]
    )
    assert (warned.warned, warned.doubted) == (1, 1)
    assert with_refused.refused == 1 and with_refused.milliseconds == pytest.approx(20.0)
    alone = summarise_estimates(PointModel(30, 20, 1), "it", [refused])
    assert (alone.held, alone.milliseconds, alone.removed) == (None, None, pytest.approx(0.0))
    hundred = Estimate(1e-3 * np.arange(101.0), np.ones(101), None, 0.0)
    assert summarise_estimates(PointModel(30, 20, 1), "it", [hundred]).p95 == pytest.approx(95.0)


def test_squared_error_uses_the_centroid_covariance(locator, body):
    motion = some_motion(locator, 0)
    seen = sample_observation(body, motion, PointModel(60, 60, 1), (0, 0))
    found, answer = evaluate_locator(locator, motion, seen), locator.locate(seen)
    off = answer.centroid - compute_centroid_motion(body, motion[None])[0]
    assert found.mahalanobis_square == pytest.approx(off @ np.linalg.inv(answer.centroid_covariance) @ off)
    wild = replace(seen, now=seen.rest + 0.01 * np.random.default_rng(0).standard_normal(seen.rest.shape))
    refused = evaluate_locator(locator, motion, wild)
    assert refused.is_rejected and refused.mahalanobis_square is None and np.array_equal(refused.error, refused.motion)


def test_observations_use_same_points_at_any_noise(locator, body):
    motion = some_motion(locator, 2)
    exact, low, high = (sample_observation(body, motion, PointModel(50, 36, noise), (3, 1)) for noise in (0, 1, 2))
    assert np.array_equal(exact.rest, low.rest) and np.array_equal(exact.rest, high.rest)
    assert exact.sigma == pytest.approx(np.full(50, 0.05e-3)) and low.sigma is None and high.sigma is None
    assert np.sqrt(3.0) * np.array([each.rigid for each in (exact, low, high)]) == pytest.approx([0.0, 1e-3, 2e-3])
    at = np.linalg.norm(body.mesh.nodes[:, None] - exact.rest, axis=2)
    on_vertex = at.argmin(axis=0)
    assert np.linalg.norm(exact.now - exact.rest - motion[on_vertex], axis=1).max() < 1e-3
    again = sample_observation(body, motion, PointModel(50, 36, 1), (3, 1))
    assert np.array_equal(again.now, low.now)
    others = [sample_observation(body, motion, PointModel(50, 36, 1), seed).rest for seed in ((3, 2), (4, 1))]
    assert not any(np.array_equal(low.rest, other) for other in others)
    wide = sample_observation(body, motion, PointModel(50, 100, 0), (3, 1))
    assert np.ptp(exact.rest[:, :2], axis=0).max() < 0.8 * np.ptp(wide.rest[:, :2], axis=0).max()


def test_noise_levels_have_their_rigid_translations(locator, body):
    """Mean squares over many observations: white and smooth errors are equal at both levels."""
    still, square = np.zeros_like(body.mesh.nodes), []
    for noise in (1, 2):
        seen = [sample_observation(body, still, PointModel(60, 60, noise), (0, number)) for number in range(60)]
        square.append(np.mean([1e6 * ((one.now - one.rest).mean(axis=0) ** 2).sum() for one in seen]))
    assert 1.0 < square[0] < 1.5 and square[1] - square[0] == pytest.approx(3.0, abs=0.6)


def test_every_twin_is_observed_at_its_own_points(locator, body):
    some = [SyntheticCase(sample_parameters(0, number), some_motion(locator, number)) for number in (0, 1)]
    given = []
    spy = {"spy": lambda rest, motion: given.append(rest) or np.zeros((len(body.tumour_nodes), 3))}
    found = list(measure_baselines(some, build_point_models([30], [50], [0, 1]), spy, locator))
    assert [(each.noise, each.estimator) for each in found[::3]] == [(0, "spy"), (1, "spy")] and len(found) == 6
    assert np.array_equal(given[0], given[2]) and not np.array_equal(given[0], given[1])
    clouds = list(measure_baselines(some, build_point_models([30], [50], [0], has_correspondences=False), spy, locator))
    assert [each.estimator for each in clouds] == [OURS, ORACLE] and len(given) == 4
    seen = [sample_observation(body, some[0].motion, PointModel(30, 50, 0, named), (0, 0)) for named in (True, False)]
    assert seen[1].rest is None and np.array_equal(seen[0].now, seen[1].now)
    slipped = sample_observation(body, some[0].motion, PointModel(30, 50, 0, slip=8e-3), (0, 0)).now - seen[0].now
    assert slipped == pytest.approx(np.tile(slipped[0], (30, 1))) and np.linalg.norm(slipped[0]) == pytest.approx(8e-3)
    assert slipped[0] @ open_cortex(body).axis == pytest.approx(0.0, abs=1e-9)
    wrong = [
        sample_observation(body, some[0].motion, PointModel(30, 50, 0, is_misregistered=True), (0, seed))
        for seed in range(8)
    ]
    right = [sample_observation(body, some[0].motion, PointModel(30, 50, 0), (0, seed)) for seed in range(8)]
    moved = np.stack([one.now - other.now for one, other in zip(wrong, right, strict=True)])
    shifts = np.ptp(moved, axis=1).max(axis=1) < 1e-12
    assert 0 < shifts.sum() < 8
    assert all(2e-3 <= np.linalg.norm(each[0]) <= 5e-3 for each in moved[shifts])
    assert all(np.linalg.norm(each, axis=1).max() <= np.radians(4.0) * 0.1 for each in moved[~shifts])
    with pytest.raises(InputError, match="level 3"):
        list(measure_baselines(some, build_point_models([30], [50], [3]), spy, locator))
    with pytest.raises(InputError, match="no twin"):
        list(measure_baselines([], build_point_models([30], [50], [0]), spy, locator))


@pytest.mark.parametrize("translation", [1e-3, 2e-3])
def test_observation_errors_have_nominal_size(translation):
    """White and smooth errors by differences of point pairs, the rigid error by a fit."""
    random = np.random.default_rng(0)
    site = random.uniform(-0.6, 0.6, (250, 3))
    way = random.standard_normal(site.shape)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    for apart, expected in ((0.0, 2.0 * 0.3**2), (15e-3, 2.0 * 0.3**2 + 2.0 * 0.5**2 * (1.0 - np.exp(-0.5)))):
        rest = np.concatenate([site, site + apart * way])
        now = rest + [0.01, 0.0, 0.02]  # what has moved is turned about where it was
        off = add_errors(rest, now, translation, np.random.default_rng(4)) - now
        turn = Rotation.align_vectors(now + off - (now + off).mean(axis=0), now - now.mean(axis=0))[0]
        assert np.degrees(turn.magnitude()) == pytest.approx(0.5, abs=0.01)
        left = off - (turn.apply(now - rest.mean(axis=0)) + rest.mean(axis=0) - now)
        assert np.linalg.norm(left.mean(axis=0)) == pytest.approx(translation, abs=0.1e-3)
        difference = 1e3 * (left[250:] - left[:250])
        assert (difference**2).mean() == pytest.approx(expected, rel=0.15)
        assert 1e6 * left.var(axis=0).mean() == pytest.approx(0.3**2 + 0.5**2, rel=0.15)


def test_twins_depend_only_on_seed_and_number():
    many = [sample_parameters(0, number) for number in range(200)]
    assert (
        sample_parameters(0, 5) == many[5] != replace(sample_parameters(0, 9), number=5)
        and sample_parameters(1, 5) != many[5]
    )
    assert [one.cause for one in many[:8]] == [*locate_twins.CAUSES, *locate_twins.CAUSES]
    assert {one.skull for one in many if one.cause == "drainage"} == {"contact"}
    assert {one.skull for one in many if one.cause != "drainage"} == {"contact", "bonded", "slide"}
    for name, low, high in (("stiffness", 0.5, 1.3), ("ratio", 0.5, 3.0), ("left", 0.1, 0.5)):
        values = np.array([getattr(one, name) for one in many])
        assert low <= values.min() < 1.1 * low and 0.93 * high < values.max() <= high, name
    swelling = np.array([one.swelling for one in many])
    assert np.abs(swelling).min() >= 0.02 and 0.055 < np.abs(swelling).max() <= 0.06
    assert 0.6 < (swelling > 0.0).mean() < 0.8


def test_twins_have_drawn_tissue_and_single_cause(body):
    for number in range(4):
        draw = sample_parameters(3, number)
        elasticity = locate_twins.build_effects(draw)[0]
        for law, times in ((elasticity.default, 1.0), (elasticity.regions[2], draw.ratio)):
            mu, lam = law.lame
            assert mu == pytest.approx(670.0 * draw.stiffness * times) and law.terms[0][1] == -19.0
            assert lam / (2.0 * (lam + mu)) == pytest.approx(0.49)
        loads = locate_twins.build_loads(body, draw)
        pushed, posture = loads.get(Pushed), loads.get(Posture)
        assert pushed.force.any() == ("tool" in draw.cause)
        assert (loads.times[0] != 0.0) == (draw.cause == "swelling")
        height = -body.mesh.nodes @ posture.direction[0]
        full = posture.csf_level[0] > height.max()
        assert full == ("drainage" not in draw.cause) and np.linalg.norm(posture.direction) == pytest.approx(1.0)


def test_twin_motion_follows_the_push_of_its_tool(body):
    """The push moves the open cortex along its direction, and the tumour less."""
    draw = replace(sample_parameters(0, 0), skull="slide", stiffness=1.0)
    motion = locate_twins.solve_case(body, draw, "cpu", "p1")
    pushed = locate_twins.build_loads(body, draw).get(Pushed)
    near = np.linalg.norm(body.mesh.nodes - pushed.point[0], axis=1).argmin()
    assert motion[near] @ pushed.force[0] > 0.7 * np.linalg.norm(motion[near]) * np.linalg.norm(pushed.force[0])
    deep = np.linalg.norm(motion[body.tumour_nodes], axis=1).mean()
    assert 0.02e-3 < deep < np.linalg.norm(motion[near])


def test_twins_are_stored_and_read_at_body_vertices(body, tmp_path, monkeypatch):
    finer, made = refine(body), []

    def linear(anatomy, draw, device, element):
        made.append(draw.number)
        if made == [0, 1, 2]:
            raise KeyboardInterrupt
        return None if draw.number == 1 else 0.1 * draw.stiffness * anatomy.mesh.nodes

    monkeypatch.setattr(locate_twins, "solve_case", linear)
    with pytest.raises(KeyboardInterrupt):
        list(solve_cases(body, finer, 3, seed=7, folder=tmp_path))
    heard = []
    found = list(solve_cases(body, finer, 3, seed=7, folder=tmp_path, progress=lambda *each: heard.append(each)))
    assert made == [0, 1, 2, 2] and heard == [(1, 3), (2, 3), (3, 3)] and found[1] is None
    for twin in (found[0], found[2]):
        assert twin.motion == pytest.approx(0.1 * twin.parameters.stiffness * body.mesh.nodes, abs=1e-9)
    list(solve_cases(body, finer, 1, seed=8, folder=tmp_path))  # another draw, element or mesh is another twin
    list(solve_cases(body, finer, 1, seed=7, element="p1", folder=tmp_path))
    list(solve_cases(body, body, 1, seed=7, folder=tmp_path))
    assert made[4:] == [0, 0, 0]
    kept = sorted(tmp_path.glob("twin-0000-*.npz"))
    assert len(kept) == 4
    for path in kept:
        path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(InputError, match="computed again"):
        list(solve_cases(body, finer, 1, seed=7, folder=tmp_path))


def test_mesh_of_other_brain_or_without_tumour_is_rejected(body):
    moved = replace(body, mesh=replace(body.mesh, nodes=body.mesh.nodes + [0.0, 0.01, 0.0]))
    with pytest.raises(InputError, match="10 mm apart"):
        list(solve_cases(body, moved, 1))
    with pytest.raises(InputError, match="no tumour"):
        list(solve_cases(body, replace(body, mesh=replace(body.mesh, region=np.ones_like(body.mesh.region))), 1))


def test_locate_command_prints_estimator_rows_and_resumes(body, locator, tmp_path, monkeypatch, capsys):
    made = []

    def some(anatomy, draw, device, element):
        made.append(draw.number)
        return None if draw.number == 2 else some_motion(locator, draw.number)

    monkeypatch.setattr(locate_twins, "solve_case", some)
    monkeypatch.setattr(locator_store, "make_locator", lambda *each, **named: made.append("locator") or locator)
    path, folder = tmp_path / "body.vtu", tmp_path / "kept"
    write_anatomy(path, body)
    words = ["locate", "--anatomy", str(path), "--finer", str(path), "--twins", "4", "--points", "60", "80"]
    words += ["--cover", "50", "--noise", "0", "1", "--folder", str(folder), "--device", "cpu"]
    assert main(words) == 1  # one twin failed
    out, err = capsys.readouterr()
    lines = [line for line in out.splitlines() if line.startswith("| ")]
    assert len(lines) == 1 + 2 * 2 * 7 and "3 twins" in out and "of twins [2]" in err
    assert main([*words, "--json"]) == 1
    assert made == [0, 1, 2, 3, "locator"]
    found = json.loads(capsys.readouterr().out)
    assert found["failed"] == [2] and len(found["rows"]) == 28
    by_name = {each["estimator"]: each for each in found["rows"] if (each["points"], each["noise"]) == (80, 0)}
    assert by_name["nothing moved"]["removed"] == pytest.approx(0.0)
    assert 60.0 < by_name[OURS]["removed"] < 100.0 and by_name[OURS]["milliseconds"] > 0.0
    assert by_name[OURS]["held"] in (pytest.approx(100.0 * count / 3.0) for count in range(4))
    assert by_name["best sum of its shapes"]["removed"] > 99.9
    assert by_name["best sum of its shapes"]["milliseconds"] is None and by_name["Kelvinlets"]["held"] is None


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["--twins", "0"], "--twins is 0"),
        (["--points", "5"], "--points is 5"),
        (["--cover", "101"], "--cover 101"),
        (["--seed", "-1"], "--seed is -1"),
        (["--slip", "51"], "--slip 51"),
        (["--anatomy", "own.vtu"], "--anatomy needs --finer"),
    ],
)
def test_locate_bench_rejects_invalid_input(words, match, capsys):
    assert main(["locate", *words]) == 2
    assert match in capsys.readouterr().err
