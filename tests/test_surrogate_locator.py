"""Locating a tumour from observations: small ensemble, motions outside it, and invalid observations."""

from dataclasses import replace

import numpy as np
import pytest

from sim.errors import InputError
from surrogate.locating import ensemble as ensembles
from surrogate.locating.causes import KINDS, Causes, build_groups
from surrogate.locating.ensemble import compute_surface_motion, solve_groups, solve_members
from surrogate.locating.locator import Locator
from surrogate.locating.locator_store import load_locator, make_locator, save_locator
from surrogate.locating.observation import Observation, to_evidence
from surrogate.locating.prior import NO_PLACE, PRESS, compute_centroid_motion

FEW = Causes(
    poisson=(0.45, 0.485), tools=(8, 3), drainages=3, levels=(0.6, 0.3), swellings=(0.04, 0.02, -0.02),
    tumour_swellings=(0.2, -0.1), oedema=(0.1,), reach=(8e-3, 16e-3), reaches=(1, 1),
)  # fmt: skip


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    return tmp_path_factory.mktemp("parts")


@pytest.fixture(scope="module")
def locator(body, parts):
    return make_locator(body, causes=FEW, device="cpu", folder=parts, count=240)


@pytest.fixture(scope="module")
def ensemble(body, parts, locator):
    """That which the locator was made of, read from where it was kept."""
    return solve_groups(body, causes=FEW, device="cpu", folder=parts)


@pytest.fixture(scope="module")
def truth(body):
    """Motions of another tissue and of other loads than the ensemble's, of each skull, 3 mm at the surface."""
    found = []
    for group in build_groups(body, seed=7, causes=FEW)[::2]:
        motion, kind = solve_members(body, replace(group, poisson=0.47), seed=7, device="cpu", causes=FEW)
        size = compute_surface_motion(body, motion)
        found += [(3e-3 * motion[n] / size[n], KINDS[kind[n]]) for n in range(0, len(motion), 3)]
    return found


def observed(body, motion, seed=0, count=60, bias=0.0, noise=1.0):
    """Points all over the open cortex, with white, smooth and rigid errors; and the rigid translation."""
    random = np.random.default_rng(seed)
    triangles = body.open_surface[random.integers(len(body.open_surface), size=count)]
    share = random.dirichlet(np.ones(3), count)
    rest = np.einsum("nc,nci->ni", share, body.mesh.nodes[triangles])
    moved = np.einsum("nc,nci->ni", share, motion[triangles])
    near = np.exp(-0.5 * ((rest[:, None] - rest) ** 2).sum(axis=2) / 15e-3**2) + 1e-9 * np.eye(count)
    smooth = np.linalg.cholesky(near) @ random.standard_normal((count, 3))
    off = bias * np.array([0.6, -0.8, 0.0])
    return Observation(
        rest + moved + noise * (0.3e-3 * random.standard_normal((count, 3)) + 0.5e-3 * smooth) + off, rest
    )


def test_ensemble_contains_every_cause_for_every_skull(ensemble, body):
    assert {(kind, skull) for kind, skull in zip(ensemble.kind, ensemble.skull, strict=True)} == {
        (kind, skull) for kind in range(len(KINDS)) for skull in range(3)
    }
    assert np.isfinite(ensemble.motion).all() and ensemble.motion.shape[1:] == body.mesh.nodes.shape


def test_prior_shapes_move_open_cortex_by_1_mm(locator, body):
    prior = locator.prior
    for skull in (0, 1):
        for place in (NO_PLACE, 0, int(prior.place.max())):
            rows = (prior.kind == 0) & (prior.skull == skull) & (prior.place == place)
            size = compute_surface_motion(body, prior.shape[rows])
            assert np.sqrt((size**2).sum()) == pytest.approx(1e-3, rel=1e-4)
    assert prior.place.max() == PRESS.place_count - 1 and not ((prior.kind == 0) & (prior.skull == 2)).any()


def test_stopped_ensemble_run_resumes(body, tmp_path, monkeypatch, ensemble):
    made = []

    def stopped(anatomy, group, *rest):
        made.append(group.number)
        if len(made) == 3:
            raise KeyboardInterrupt
        chosen = ensemble.group == group.number
        return ensemble.motion[chosen], ensemble.kind[chosen]

    monkeypatch.setattr(ensembles, "solve_members", stopped)
    with pytest.raises(KeyboardInterrupt):
        solve_groups(body, causes=FEW, device="cpu", folder=tmp_path)
    found = solve_groups(body, causes=FEW, device="cpu", folder=tmp_path)
    assert made == [0, 1, 2, 2, 3, 4]
    for name in ("motion", "kind", "skull", "group"):
        assert np.array_equal(getattr(found, name), getattr(ensemble, name)), name


def test_restricted_locator_agrees_with_the_full_locator(locator, body, truth, tmp_path):
    """Named points, a cloud and tips, with a locator read from its smaller file."""
    save_locator(tmp_path / "small.npz", locator.restrict())
    small = load_locator(tmp_path / "small.npz", body)
    nodes = small.prior.nodes
    assert len(nodes) < len(body.mesh.nodes) == len(locator.prior.shape[0])
    assert np.isin(body.tumour_nodes, nodes).all() and np.isin(body.open_surface, nodes).all()
    for number, (motion, _) in enumerate(truth):
        seen = observed(body, motion, number)
        cloud = Observation(seen.now, sigma=seen.sigma)
        for each in (seen, cloud, replace(seen, tips=seen.now[:1])):
            ours, whole = small.locate(each), locator.locate(each)
            assert ours.centroid == pytest.approx(whole.centroid, abs=1e-6)
            assert ours.p95 == pytest.approx(whole.p95, rel=1e-3)
            assert ours.compute_motion(nodes) == pytest.approx(whole.compute_motion(nodes), abs=1e-6)
            assert ours.compute_covariance(body.tumour_nodes) == pytest.approx(
                whole.compute_covariance(body.tumour_nodes), rel=1e-3
            )
            assert ours.causes == pytest.approx(whole.causes, abs=1e-3)


def test_restricted_locator_rejects_unknown_vertices(locator, body, truth):
    small = locator.restrict()
    seen = observed(body, truth[0][0])
    other = np.setdiff1d(np.arange(len(body.mesh.nodes)), small.prior.nodes)
    for asked in (other[:1], np.append(body.tumour_nodes, other[-1])):
        with pytest.raises(InputError, match="this locator knows"):
            small.locate(seen).compute_motion(asked)
    with pytest.raises(InputError, match="this locator knows"):
        small.prior.restrict(other)
    deep = replace(seen, rest=seen.rest - [0.0, 0.0, 11e-3], now=seen.now - [0.0, 0.0, 11e-3])
    deep = replace(
        deep, **{name: np.concatenate([getattr(seen, name), getattr(deep, name)]) for name in ("rest", "now")}
    )
    with pytest.raises(InputError, match="this locator knows"):
        small.locate(replace(deep, sigma=None))


def test_locator_files_round_trip_and_reject_foreign_nodes(locator, body, tmp_path):
    path = tmp_path / "box.locator.npz"
    save_locator(path, locator)
    again = load_locator(path, body)
    assert np.array_equal(again.tried, locator.tried)
    for name in ("shape", "kind", "skull", "place", "centre"):
        assert np.array_equal(getattr(again.prior, name), getattr(locator.prior, name)), name
    with pytest.raises(InputError, match="another anatomy"):
        load_locator(path, replace(body, craniotomy=body.craniotomy & (body.mesh.nodes[:, 0] > 0.04)))
    path.write_bytes(path.read_bytes()[:-4000])
    with pytest.raises(InputError, match="locator"):
        load_locator(path, body)
    prior = locator.prior
    for spoilt in (
        replace(prior, shape=np.full_like(prior.shape, np.nan)),
        replace(prior, kind=prior.kind + 4),
        replace(prior, place=prior.place[1:]),
        replace(prior, centre=prior.centre[1:]),
    ):
        save_locator(tmp_path / "wild.npz", Locator(spoilt, locator.tried))
        with pytest.raises(InputError, match="do not fit"):
            load_locator(tmp_path / "wild.npz", body)
    small = locator.restrict().prior
    for nodes in (small.nodes[::-1], small.nodes[1:], small.nodes + len(body.mesh.nodes), small.nodes + 0.5):
        save_locator(tmp_path / "wild.npz", Locator(replace(small, nodes=nodes), locator.tried))
        with pytest.raises(InputError, match="do not fit"):
            load_locator(tmp_path / "wild.npz", body)


def test_located_tumour_motion_is_within_error_ellipsoids(locator, body, truth):
    """Tissue, loads and errors outside the ensemble; the ellipsoid covers at least 85 % of them."""
    left, all_of_it, held = 0.0, 0.0, []
    for seed, (motion, _) in enumerate(truth):
        found = locator.locate(observed(body, motion, seed))
        middle = compute_centroid_motion(body, motion[None])[0]
        off = found.centroid - middle
        left, all_of_it = left + np.linalg.norm(off), all_of_it + np.linalg.norm(middle)
        held.append(off @ np.linalg.solve(found.centroid_covariance, off) < 7.815)
        assert np.linalg.eigvalsh(found.centroid_covariance).min() > 0.0
        covariance = found.compute_covariance(body.tumour_nodes)
        assert covariance.shape == (len(body.tumour_nodes), 3, 3) and np.linalg.eigvalsh(covariance).min() > 0.0
        assert sum(found.causes.values()) == pytest.approx(float(not found.within_errors)) and found.calibrated
    assert left < 0.35 * all_of_it and np.mean(held) > 0.85


def test_covariances_scale_with_trial_errors(locator, body, truth):
    """Doubled errors in trials give fourfold covariances and a doubled radius."""
    seen = observed(body, truth[0][0])
    found = locator.locate(seen)
    wider = Locator(locator.prior, locator.tried * [1.0, 1.0, 1.0, 1.0, 4.0]).locate(seen)
    assert wider.centroid == pytest.approx(found.centroid)
    assert wider.centroid_covariance == pytest.approx(4.0 * found.centroid_covariance)
    assert wider.p95 == pytest.approx(2.0 * found.p95)
    random = np.random.default_rng(5)
    drawn = random.multivariate_normal(np.zeros(3), found.centroid_covariance, 4000)
    assert np.mean(np.linalg.norm(drawn, axis=1) < found.p95) == pytest.approx(0.95, abs=0.012)


def test_rigid_error_is_not_attributed_to_tumour_motion(locator, body, truth):
    """Most of a translation by 2 mm along the surface is estimated as bias, and little as tumour motion."""
    moved, known = [], []
    for seed, (motion, _) in enumerate(truth[::2]):
        without = locator.locate(observed(body, motion, seed))
        found = locator.locate(observed(body, motion, seed, bias=2e-3))
        moved.append(np.linalg.norm(found.centroid - without.centroid))
        known.append((found.bias - without.bias) @ [0.6, -0.8, 0.0])
    assert np.median(known) > 1e-3 and np.median(moved) < 1e-3


def test_reported_rigid_error_is_estimated(locator, body, truth):
    """4 mm of rigid error are estimated if reported as possible; otherwise none is, or a slip is reported."""
    off = np.zeros(3)
    for seed, (motion, _) in enumerate(truth[::2]):
        seen = observed(body, motion, seed, bias=4e-3)
        found = [locator.locate(replace(seen, rigid=rigid)) for rigid in (0.0, 0.8e-3, 2.5e-3)]
        cloud = Observation(seen.now, sigma=np.full(60, 3e-3), rigid=0.0)
        tipped = replace(seen, tips=seen.now[:1], rigid=0.0)
        for exact in (found[0], locator.locate(cloud), locator.locate(tipped)):
            assert exact.slipped or np.abs([exact.bias, exact.rotation]).max() < 1e-6
        off += [np.linalg.norm(each.centroid - compute_centroid_motion(body, motion[None])[0]) for each in found]
    assert off[2] < off[1] < off[0]


def test_point_cloud_recovers_the_normal_displacement(locator, body, truth):
    left, all_of_it = 0.0, 0.0
    for seed, (motion, _) in enumerate(truth):
        named = observed(body, motion, seed, count=150, noise=0.2)
        found = locator.locate(Observation(named.now, sigma=np.full(150, 0.15e-3)))
        middle = compute_centroid_motion(body, motion[None])[0]
        left, all_of_it = left + abs((found.centroid - middle)[2]), all_of_it + abs(middle[2])
    assert left < 0.4 * all_of_it


def test_point_cloud_may_lie_14_mm_below_the_cortex(locator, body):
    """A cloud lies on the displaced surface; named points are searched at rest, within a smaller distance."""
    rest = observed(body, np.zeros_like(body.mesh.nodes)).rest
    sunk = rest - [0.0, 0.0, 14e-3]
    assert to_evidence(body, Observation(sunk)).motion == pytest.approx(-14e-3)
    for far in (Observation(rest - [0.0, 0.0, 19e-3]), Observation(rest, sunk)):
        with pytest.raises(InputError, match="from the open cortex"):
            to_evidence(body, far)


def test_gross_outliers_change_the_result_little(locator, body, truth):
    motion = truth[0][0]
    clean = observed(body, motion, 3)
    now = clean.now.copy()
    now[[5, 17, 29, 41, 53]] += [0.0, 0.012, -0.015]
    found, without = locator.locate(replace(clean, now=now)), locator.locate(clean)
    assert set(found.outliers) >= {5, 17, 29, 41, 53}
    assert np.linalg.norm(found.centroid - without.centroid) < 0.3 * np.linalg.norm(without.centroid) + 0.2e-3


def test_points_off_the_cortex_are_excluded_and_reported(locator, body, truth):
    """They change only the number of points; more than a third of them are rejected."""
    clean = observed(body, truth[0][0], 3)
    few, many = (np.arange(60) % 10 < number for number in (1, 4))
    spoilt = [
        replace(clean, rest=np.where(some[:, None], clean.rest - [0.0, 0.0, 0.03], clean.rest)) for some in (few, many)
    ]
    found = locator.locate(spoilt[0])
    assert found.outliers.tolist() == np.flatnonzero(few).tolist()
    without = locator.locate(Observation(clean.now[~few], clean.rest[~few]))
    assert found.centroid == pytest.approx(without.centroid) and found.p95 == pytest.approx(without.p95)
    with pytest.raises(InputError, match="24 of 60 points lie off the open cortex"):
        locator.locate(spoilt[1])


def test_unsupported_tool_tip_is_excluded(locator, body, truth):
    clean = observed(body, truth[0][0], 3, noise=0.1)
    sure = replace(clean, sigma=np.full(60, 1e-4))
    wrong = replace(sure, tips=clean.now[:1] + [0.0, 0.0, 0.025])
    found, without = locator.locate(wrong), locator.locate(sure)
    assert found.outlier_tips.tolist() == [0] and not len(found.outliers)
    assert found.centroid == pytest.approx(without.centroid, abs=1e-9)
    right = locator.locate(replace(sure, tips=clean.now[:1]))
    assert not len(right.outlier_tips)


@pytest.mark.parametrize("rigid", [0.0, 0.8e-3])
def test_motionless_observation_gives_zero_displacement(locator, body, rigid):
    """With and without rigid error: motion below the noise is unknown."""
    seen = observed(body, np.zeros_like(body.mesh.nodes))
    found = locator.locate(replace(seen, now=seen.rest, rigid=rigid))
    assert not found.centroid.any() and found.explained == 0.0 and not found.calibrated
    assert found.causes == dict.fromkeys(KINDS, 0.0) and found.p95 > 0.0


def test_rigid_fit_reports_its_share_of_the_observed_motion(locator, body, truth):
    """Nearly all of a uniform shift, and less of a dent, for points and clouds."""
    shifted = replace(observed(body, np.zeros_like(body.mesh.nodes)), rigid=0.8e-3)
    shifted = replace(shifted, now=shifted.rest + [0.0, 0.0, -4e-3])
    for seen in (shifted, replace(shifted, rest=None)):
        alone = locator.locate(seen).rigid_alone
        assert alone.share == pytest.approx(1.0, abs=0.02) and alone.shift == pytest.approx(4e-3, rel=0.05)
    assert locator.locate(observed(body, truth[0][0], noise=0.2)).rigid_alone.share < 0.9


def test_drainage_motion_is_attributed_to_drainage(locator, body, truth):
    """Drainage has the largest share in more than half of the drained motions."""
    found = [(kind, locator.locate(observed(body, motion, 1, noise=0.2)).causes) for motion, kind in truth]
    drained = [max(causes, key=causes.get) for kind, causes in found if kind == "drainage"]
    assert np.mean([name == "drainage" for name in drained]) > 0.5
    assert all(set(causes) == set(KINDS) for _, causes in found)


def along_x(points):
    """The same without their spread across."""
    middle = points.mean(axis=0)
    return middle + (points - middle) * [1.0, 1e-3, 1e-3]


@pytest.mark.parametrize(
    ("spoilt", "match"),
    [
        (lambda o: replace(o, now=1e3 * o.now, rest=1e3 * o.rest), "a thousandth of that: files are in mm"),
        (lambda o: replace(o, now=0.1 * o.rest, rest=None), "they look like centimetres"),
        (lambda o: replace(o, now=1e-3 * o.now, rest=1e-3 * o.rest), "a thousand times of that"),
        (lambda o: replace(o, rest=o.rest + [0.0, 0.0, 0.05]), "another brain or frame"),
        (lambda o: replace(o, now=o.now + 0.2), "which no brain does"),
        (lambda o: replace(o, tips=o.now[:1] + [0.0, 0.0, 0.1]), r"tip 1 is \d+ mm from the open cortex"),
        (lambda o: replace(o, now=o.now[:50]), "50 points have 60 places at rest"),
        (lambda o: replace(o, now=o.now[:, :2]), "no array of shape"),
        (lambda o: replace(o, sigma=np.ones(3)), "60 points have a sigma of shape"),
        (
            lambda o: replace(o, now=np.repeat(o.now[:5], 12, 0), rest=np.repeat(o.rest[:5], 12, 0)),
            "5 places a millimetre apart say too little",
        ),
        (lambda o: replace(o, now=o.now[:5], rest=o.rest[:5]), "5 points say too little"),
        (lambda o: replace(o, now=along_x(o.rest), rest=along_x(o.rest)), "on a line"),
        (lambda o: replace(o, now=np.where(np.arange(60)[:, None] == 7, np.nan, o.now)), "not finite"),
        (lambda o: replace(o, sigma=np.zeros(60)), "a sigma is not positive"),
        (lambda o: replace(o, rigid=-1e-3), "a rigid error of -1 mm is none that a tracker has"),
        (lambda o: replace(o, rigid=0.8), "a rigid error of 800 mm .* from 0 to 20 mm"),
        (lambda o: replace(o, rigid=np.nan), "a rigid error of nan mm"),
        (lambda o: replace(o, now=o.rest + 0.01 * np.random.default_rng(0).standard_normal((60, 3))), "fit"),
    ],
)
def test_invalid_observations_are_rejected_with_reason(locator, body, truth, spoilt, match):
    with pytest.raises(InputError, match=match):
        locator.locate(spoilt(observed(body, truth[0][0])))


def test_observation_in_lps_is_rejected_with_hint(locator, body):
    there = observed(body, np.zeros_like(body.mesh.nodes))
    turned = replace(there, now=there.now * [-1.0, -1.0, 1.0], rest=there.rest * [-1.0, -1.0, 1.0])
    with pytest.raises(InputError, match=r"they are LPS\. Give mm and RAS"):
        locator.locate(turned)
