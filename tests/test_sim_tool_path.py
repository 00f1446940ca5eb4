"""Path of a tool: its length, and the number of strides along it."""

import numpy as np
from test_sim_contact_descent import BODY, HEIGHT, RADIUS, at, solver, touching

from sim.accuracy import TRAIN
from sim.discretisation.term import Cases
from sim.terms.contact.tool_path import ContactSampling, ToolPath
from sim.tools import Ball


def test_stride_is_clearance_plus_part_of_the_radius() -> None:
    tool = Ball(RADIUS)
    begin, end = at(0.0, 0.0, 0.1)[None, None], at(0.1, 0.0, 0.1)[None, None]
    way = ToolPath(begin, end)
    np.testing.assert_allclose(way.compute_stride((tool,), np.zeros((1, 1))), ContactSampling.max_stride * RADIUS / 0.1)
    np.testing.assert_allclose(
        way.compute_stride((tool,), np.full((1, 1), 0.04)), (0.04 + ContactSampling.max_stride * RADIUS) / 0.1
    )
    np.testing.assert_allclose(way.compute_stride((tool,), np.full((1, 1), 0.2)), 1.0)


def test_tool_in_air_needs_few_strides() -> None:
    """Next to the body, and moving away: at 9 cm distance, 7 cm are free in every direction."""
    fem = solver(TRAIN)
    term = fem.problem.barriers[0]
    poses = at(-0.09, 0.03, HEIGHT + 5e-3), at(-0.33, 0.03, HEIGHT + 5e-3)
    there = fem.deform(touching(poses[0]))
    cases = Cases(touching(poses[1]), np.zeros(1), there.memory, np.zeros((1, len(BODY.mesh.nodes), 3)), np.zeros(1))
    stride = term.compute_stride(cases, fem.problem.device.allocate(fem.problem.rows, 1))
    assert stride[0] > 0.07 / 0.24 > 10.0 * ContactSampling.max_stride * RADIUS / 0.24
