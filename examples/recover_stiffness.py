"""Recover the stiffness of brain and tumour from measured displacements of the cortex, with its uncertainty.

Two pushes move the cortex in the craniotomy. Its measured motion has errors of 0.05 mm. Gauss-Newton iterations with
exact derivatives of the equilibrium find Young's modulus of both regions, and their covariance.
"""

from dataclasses import replace

import numpy as np

import sim
from scenes import get_template_path

BRAIN_LABEL, TUMOUR_LABEL, NOISE = 1, 2, 5e-5
anatomy = sim.read_anatomy(get_template_path())
cortex = sim.open_cortex(anatomy)
places = [cortex.place(right_mm=0, up_mm=0), cortex.place(right_mm=8, up_mm=4)]
loads = sim.stack([sim.push(place.point, 0.2 * place.inward, footprint=7e-3) for place in places])
seen = np.flatnonzero(anatomy.craniotomy)


def build(young):
    """Return the solver for Young's moduli (2,) [Pa] of brain and tumour."""
    tissues = {label: sim.BRAIN.replace_constants(float(one)) for label, one in zip((1, 2), young, strict=True)}
    effects = [replace(one, default=None, regions=tissues) if isinstance(one, sim.Elasticity) else one
               for one in sim.build_push_effects(anatomy, sim.BRAIN)]  # fmt: skip
    return sim.Fem(anatomy, effects, replace(sim.REFERENCE, tolerance=1e-6), "cpu", element="p1")


truth = np.array([2400.0, 7000.0])
random = np.random.default_rng(0)
measured = build(truth).deform(loads).displacement[:, seen]
measured = measured + NOISE * random.standard_normal(measured.shape)

young = np.array([3000.0, 3000.0])
course = [young]
for number in range(20):
    fem = build(young)
    found = fem.deform(loads)
    # Derivatives by the logarithm of each modulus, which stays positive.
    slopes = sim.compute_jacobian(fem, loads, found, [(BRAIN_LABEL, "young"), (TUMOUR_LABEL, "young")])
    design = (slopes[:, :, seen] * young[:, None, None, None]).reshape(2, -1).T
    missing = (measured - found.displacement[:, seen]).ravel()
    step, *_ = np.linalg.lstsq(design, missing)
    young = young * np.exp(np.clip(step, -0.7, 0.7))
    course.append(young)
    print(f"{number}: brain {young[0]:.0f} Pa, tumour {young[1]:.0f} Pa, residual {1e3 * missing.std():.4f} mm")
    if np.abs(step).max() < 1e-3:
        break
deviation = NOISE * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
print("standard deviations:", ", ".join(f"{100 * one:.1f} %" for one in deviation))
assert np.abs(step).max() < 1e-3
assert (np.abs(np.log(young / truth)) < 3 * deviation).all()
