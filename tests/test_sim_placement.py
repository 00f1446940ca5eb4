"""Position of the craniotomy, and names of locations."""

import numpy as np
import pytest

from sim.bodies.mesher import INTRICATE, Meshing, build_count_error
from sim.bodies.placement import Placement, describe_side, find_opening_at, find_opening_over, find_reachable_site
from sim.errors import InputError

LOW, HIGH = np.array([-0.07, -0.09, -0.06]), np.array([0.07, 0.09, 0.08])


@pytest.fixture(scope="module")
def cortex():
    """Points of an egg of 140 x 180 x 140 mm, with a fissure to its middle in the plane x = 0 at the top."""
    rng = np.random.default_rng(0)
    way = rng.normal(size=(2000, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    outer = way * [0.07, 0.09, 0.07]
    fissure = np.column_stack([np.zeros(500), rng.uniform(-0.05, 0.05, 500), rng.uniform(0.0, 0.04, 500)])
    return np.concatenate([outer, fissure])


def test_craniotomy_is_centred_on_reachable_cortex(cortex):
    asked = np.array([-0.055, 0.02, 0.05])
    site = find_opening_at(cortex, asked)
    assert np.linalg.norm(site - asked) == pytest.approx(np.linalg.norm(cortex - asked, axis=1).min())
    # From a point in the fissure the skull is reached over it, not in it.
    site = find_opening_over(cortex, np.array([0.005, 0.0, 0.035]), 0.01)
    assert abs(np.linalg.norm(site / [0.07, 0.09, 0.07]) - 1.0) < Placement().max_hull_depth / 0.07 and site[2] > 0.06


@pytest.mark.parametrize(
    ("place", "reason"),
    [
        ((0.2, 0.0, 0.0), "lies 130 mm from the nearest cortex"),
        ((0.0, 0.0, 0.03), "give --opening-over"),
        ((0.0, 0.0, -0.072), "over the brainstem"),
        ((np.nan, 0.0, 0.0), "finite"),
    ],
)
def test_impossible_craniotomy_is_rejected_with_reason(cortex, place, reason):
    with pytest.raises(InputError, match=reason):
        find_opening_at(cortex, np.array(place))


def test_largest_distance_from_surface_is_an_option(cortex):
    asked = np.array([0.0, 0.0, 0.12])
    with pytest.raises(InputError, match="50 mm is the most"):
        find_opening_at(cortex, 1.3 * asked, Placement(max_surface_distance=0.05))
    assert find_opening_at(cortex, asked, Placement(max_surface_distance=0.06))[2] > 0.06


def test_craniotomy_over_point_outside_brain_is_rejected(cortex):
    with pytest.raises(InputError, match="lies 30 mm outside the brain"):
        find_opening_over(cortex, np.array([0.1, 0.0, 0.0]), -0.03)
    with pytest.raises(InputError, match="over the brainstem"):
        find_opening_over(cortex, np.array([0.0, 0.0, -0.069]), 0.0)
    deep = find_reachable_site(cortex, np.array([0.0, 0.0, 0.0]))
    assert deep[2] >= -0.07 + Placement().min_height * 0.14 - 1e-3


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ((-0.05, 0.07, 0.06), "left anterior superior"),
        ((0.05, -0.07, -0.04), "right posterior inferior"),
        ((0.0, 0.0, 0.01), "midline"),
        ((0.03, 0.0, 0.01), "right"),
    ],
)
def test_location_names_follow_clinical_usage(place, words):
    assert describe_side(np.array(place), LOW, HIGH) == words


def test_too_few_nodes_are_rejected_with_sufficient_number():
    asked = []

    def would_do(count):
        asked.append(count)
        return count >= 4000

    message = str(build_count_error(3000, INTRICATE, Meshing().factors, would_do))
    assert "too intricate for 3000 nodes: ask for 4800, or smooth" in message and asked == [3800, 4800]
    assert "for 1000 nodes: smooth the labels" in str(build_count_error(1000, INTRICATE, Meshing().factors, would_do))
