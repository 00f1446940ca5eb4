"""Locators by formula, of any small body: they take seconds."""

from dataclasses import replace

import numpy as np
from conftest import make_box

from sim.anatomy import Anatomy
from sim.bodies.open_cortex import open_cortex
from sim.runtime.threads import limit_to_one_thread
from surrogate.locating.calibration import run_trials
from surrogate.locating.causes import PressResponses, solve_presses
from surrogate.locating.ensemble import Ensemble
from surrogate.locating.locator import Locator
from surrogate.locating.prior import build_prior


def in_a_skull() -> Anatomy:
    """A small box on a floor that is held, with a skull round its sides, off the origin as openings are."""
    box = make_box(cells=(8, 8, 5), spacing=9e-3, tumour=12e-3, opening=30e-3)
    nodes = box.mesh.nodes
    normal, held = np.zeros_like(nodes), box.fixed.copy()
    for axis in (0, 1):
        side = (np.abs(nodes[:, axis]) > 36e-3 - 1e-9) & (nodes[:, 2] > -45e-3 + 1e-9) & ~normal.any(axis=1)
        normal[side] = np.sign(nodes[side]) * np.eye(3)[axis]
        held[side] = False
    mesh = replace(box.mesh, nodes=nodes + [0.04, 0.03, 0.02])
    return replace(box, mesh=mesh, fixed=held, slide_normal=normal)


def dent(body: Anatomy, random: np.random.Generator) -> np.ndarray:
    """A motion (V, 3) [m] that fades away from some place of the open cortex, mostly along the axis."""
    frame = open_cortex(body)
    at = (body.mesh.nodes - frame.origin) @ np.column_stack([frame.right, frame.up, frame.axis])
    middle = np.append(random.uniform(-0.02, 0.02, 2), 0.0)
    fall = np.exp(-0.5 * (((at - middle) / [0.025, 0.025, 0.03]) ** 2).sum(axis=1))
    way = random.normal(size=3) * [0.3, 0.3, 1.0]
    return 3e-3 * fall[:, None] * (way @ np.stack([frame.right, frame.up, frame.axis]))


def locator_of(body: Anatomy, solved: bool = False) -> Locator:
    """Of dents: each cause in each skull, and tools on every place. What tools do may be solved."""
    random = np.random.default_rng(0)
    members, count = np.array([dent(body, random) for _ in range(60)], np.float32), np.arange(60)
    ensemble = Ensemble(body, members, count % 5, count // 5 % 3, count // 15)
    points = body.mesh.nodes[np.unique(body.open_surface)]
    dents = np.array([[dent(body, random) for _ in range(3)] for _ in points], np.float32)[None]
    presses = PressResponses(points, {"bonded": dents, "slide": dents})
    if solved:
        found = solve_presses(body, ("bonded",), "cpu")
        presses = replace(found, motion=dict.fromkeys(presses.motion, found.motion["bonded"]))
    with limit_to_one_thread():
        return Locator(build_prior(ensemble, presses), run_trials(ensemble, presses, count=240))
