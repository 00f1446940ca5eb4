"""Where an error of stiffness matters: derivative of the tumour's motion by the stiffness of each tetrahedron.

One adjoint solve gives all 25,000 derivatives. Divided by the volumes they are an image: it shows where the
segmentation of a stiff or a soft region has to be right.
"""

import numpy as np

import sim
from scenes import get_template_path

anatomy = sim.read_anatomy(get_template_path())
place = sim.open_cortex(anatomy).place(right_mm=0, up_mm=0)
fem = sim.Fem(anatomy, sim.build_push_effects(anatomy, sim.BRAIN), sim.REFERENCE, "cpu", element="p1")
loads = sim.push(place.point, 0.2 * place.inward, footprint=7e-3)

# Reading: mean motion of the tumour along the push.
seed = np.zeros((1, len(anatomy.mesh.nodes), 3))
seed[:, anatomy.tumour_nodes] = place.inward / len(anatomy.tumour_nodes)
found = fem.deform(loads)
motion = (found.displacement * seed).sum()
gradient = sim.differentiate_equilibrium(fem, loads, found, seed)

# Change of the motion [m] per relative change of a tetrahedron's stiffness.
change = gradient.compute_by_tetrahedron("young")[0] * sim.BRAIN.young
centres = anatomy.mesh.nodes[anatomy.mesh.tets].mean(axis=1)
near = np.linalg.norm(centres - place.point, axis=1) < 0.02
tumour = np.isin(anatomy.mesh.tets, anatomy.tumour_nodes).all(axis=1)
for name, mask in (("tumour", tumour), ("brain within 20 mm of the tool", near & ~tumour), ("rest", ~near & ~tumour)):
    print(f"{name}, {mask.sum()} tetrahedra, 10 % stiffer: motion {0.1 * change[mask].sum() / motion:+.1%}")
print(f"all 10 % stiffer: {0.1 * change.sum() / motion:+.1%}; motion {1e3 * motion:.2f} mm")
assert -1.3 < change.sum() / motion < -0.8  # about 1 / E
image = np.abs(change) / anatomy.mesh.volumes  # [m/m^3]
assert np.median(image[near]) > 5.0 * np.median(image[~near])
