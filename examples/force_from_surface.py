"""Find the force of a tool from the observed motion of the cortex, with its uncertainty.

The place of the tool is known, its force is not. The cortex in the craniotomy is observed with errors of 0.3 mm, as by
a stereo camera. Gauss-Newton iterations use the derivatives of the equilibrium with respect to the force.
"""

import time

import numpy as np

import sim
from scenes import get_template_path

NOISE = 3e-4
anatomy = sim.read_anatomy(get_template_path())
place = sim.open_cortex(anatomy).place(right_mm=6, up_mm=-3)
fem = sim.Fem(anatomy, sim.build_push_effects(anatomy, sim.BRAIN), sim.TRAIN, "cpu", element="p1")
seen = np.flatnonzero(anatomy.craniotomy)


def deform(force, start=None):
    """Return the loads of a force (3,) [N], and their equilibrium."""
    loads = sim.push(place.point, force, footprint=7e-3)
    return loads, fem.deform(loads, start=start)


truth = 0.3 * place.inward + np.array([0.05, -0.02, 0.0])
random = np.random.default_rng(0)
observed = deform(truth)[1].displacement[0, seen] + NOISE * random.standard_normal((len(seen), 3))

force, began = 0.1 * place.inward, time.perf_counter()
found = None
for number in range(10):
    loads, found = deform(force, found)
    design = sim.compute_jacobian(fem, loads, found, arrays=[(0, "force")])[:, 0, seen].reshape(3, -1).T
    missing = (observed - found.displacement[0, seen]).ravel()
    step, *_ = np.linalg.lstsq(design, missing)
    force = force + step
    print(f"{number}: force {np.round(force, 4)} N, residual {1e3 * missing.std():.3f} mm")
    if np.linalg.norm(step) < 1e-3 * np.linalg.norm(force):
        break
error = np.linalg.norm(force - truth) / np.linalg.norm(truth)
deviation = NOISE * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
print(f"error {error:.1%}; standard deviations {np.round(deviation, 4)} N; {time.perf_counter() - began:.1f} s")
assert error < 0.05
assert (np.abs(force - truth) < 4 * deviation).all()
