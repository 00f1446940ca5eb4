"""Fit of tissue to several frames: a small body with known tissue, and invalid input."""

from dataclasses import replace

import numpy as np
import pytest
from locators import locator_of

from sim.effects import SKULLS
from sim.fem import Fem
from surrogate.fitting.fit import ModulusSettings, compute_probability, compute_tissue_likelihood, estimate_young_moduli
from surrogate.fitting.observed_frame import ObservedFrame, Tool, find_contact_point
from surrogate.fitting.responses import POISSONS, RATIOS, build_drainage_loads, build_force_loads, solve_responses
from surrogate.fitting.tissue import FINE_POISSONS, FINE_RATIOS, FittedTissue
from surrogate.locating.calibration import sample_observed_patch
from surrogate.locating.causes import YOUNG, Group
from surrogate.locating.observation import Observation


@pytest.fixture(scope="module")
def locator(body):
    return locator_of(body)


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    return tmp_path_factory.mktemp("parts")


@pytest.fixture(scope="module")
def drained(body, parts):
    return solve_responses(body, build_drainage_loads(body), "cpu", parts)


def build_tool_frame(body, motion, seed=0):
    """What is seen of a motion (V, 3) [m] without error, on most of the open cortex."""
    evidence = sample_observed_patch(body, motion, np.random.default_rng(seed), 60, 0.9)
    rest, moved = evidence.positions[::3], evidence.motion.reshape(-1, 3)
    return ObservedFrame(Observation(rest + moved, rest, np.full(len(rest), 5e-5), rigid=0.0))


def drained_frames(body, drained, skull, poisson, ratio):
    """Drained fluid in one of the solved tissues, made so large that the cortex moves by millimetres."""
    found = []
    for number in (1, 8, 15):
        motion = np.zeros_like(body.mesh.nodes)
        motion[drained.nodes] = drained.motion[skull][poisson, ratio, number]
        motion *= 3e-3 / np.linalg.norm(motion[np.unique(body.open_surface)], axis=1).max()
        found.append(build_tool_frame(body, motion, number))
    return found


@pytest.mark.parametrize(("skull", "poisson", "ratio"), [("bonded", 0, 0), ("slide", 2, 3), ("slide", 0, 2)])
def test_fit_recovers_the_tissue_of_simulated_frames(body, locator, drained, skull, poisson, ratio):
    frames = drained_frames(body, drained, skull, poisson, ratio)
    tissue = FittedTissue(
        "", 3, compute_probability(compute_tissue_likelihood(locator, frames, drained, None)), np.zeros(0)
    )
    assert tissue.skulls[skull] > 0.9
    low, middle, high = tissue.ratio
    assert low < 1.05 * RATIOS[ratio] and high > 0.95 * RATIOS[ratio]
    assert abs(np.log(middle / RATIOS[ratio])) < np.log(1.5)
    assert abs(tissue.poisson[1] - POISSONS[poisson]) < 0.012
    assert high / low < 0.7 * FINE_RATIOS[-1] / FINE_RATIOS[0]


def test_more_frames_reduce_posterior_entropy(body, locator, drained):
    frames = drained_frames(body, drained, "slide", 1, 2)
    entropy = []
    for some in (frames[:1], frames):
        share = compute_probability(compute_tissue_likelihood(locator, some, drained, None))
        entropy.append(-(share * np.log(share + 1e-300)).sum())
    assert entropy[1] < entropy[0] - 0.1


def test_nearly_motionless_points_leave_stiffness_unknown(body, locator, drained):
    frame = build_tool_frame(body, np.random.default_rng(0).normal(scale=2e-5, size=body.mesh.nodes.shape))
    frame = replace(frame, observation=replace(frame.observation, sigma=np.full(60, 5e-3), rigid=5e-3))
    tissue = FittedTissue(
        "", 1, compute_probability(compute_tissue_likelihood(locator, [frame], drained, None)), np.zeros(0)
    )
    assert "the tumour's stiffness" in tissue.not_known and "Young's modulus" in tissue.not_known


def test_measured_force_gives_young_modulus(body):
    tip = find_contact_point(body, Tool(tuple(body.mesh.nodes[np.unique(body.open_surface)].mean(axis=0).tolist())))
    loads = build_force_loads(body, tip[None], np.array([6e-3]), np.array([[0.0, 0.02, -0.12]]))
    motion = (
        Fem(body, Group(1, "slide", 0.47, 1.0, 14.0).build_effects((0.01,)), device="cpu").deform(loads).displacement[0]
    )
    tool = Tool(tuple(tip.tolist()), 6e-3, force=2.0 * float(np.hypot(0.02, 0.12)), sigma=0.005)
    frame = replace(build_tool_frame(body, motion), tools=(tool,))
    pressed = solve_responses(body, build_force_loads(body, tip[None], np.array([6e-3])), "cpu")
    share = np.zeros((len(SKULLS), len(FINE_POISSONS), len(FINE_RATIOS)))
    share[list(SKULLS).index("slide"), 6, 14] = 1.0
    young = estimate_young_moduli(body, [frame], FittedTissue("", 1, share, np.zeros(0)), pressed, "cpu")
    low, middle, high = np.quantile(young, [0.025, 0.5, 0.975])
    assert low < 2.0 * YOUNG < high and middle == pytest.approx(
        2.0 * YOUNG / ModulusSettings.mesh_force_ratio, rel=0.1
    )  # here on one mesh
    silent = [replace(frame, tools=(replace(tool, force=None, sigma=None),))]
    assert not len(estimate_young_moduli(body, silent, FittedTissue("", 1, share, np.zeros(0)), pressed, "cpu"))


def test_solved_responses_are_read_from_cache(body, parts, drained, monkeypatch):
    monkeypatch.setattr("surrogate.fitting.responses.Fem", None)
    again = solve_responses(body, build_drainage_loads(body), "cpu", parts)
    assert all(np.array_equal(again.motion[name], drained.motion[name]) for name in ("bonded", "slide"))
