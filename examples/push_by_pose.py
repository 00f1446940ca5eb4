"""Push by pose: a tool is moved, and its hand feels a force.

A ball of 7 mm is laid 2 mm deep into the cortex, as a robot's arm would be told to go. How hard tissue resists, and
where the tumour goes, come out; `Deformation.reaction` is the force that the tool exerts.
"""

import numpy as np

from scenes import get_template_path
from sim import Ball, Bonded, Elasticity, Fem, Held, Loads, ToolContact, Touching, open_cortex, read_anatomy

MM = 1e-3

anatomy = read_anatomy(get_template_path())
place = open_cortex(anatomy).place(right_mm=0, up_mm=0)
across = np.cross(place.inward, [1.0, 0.0, 0.0])
across /= np.linalg.norm(across)

# A tool's lowest point is its origin, and its shaft goes along +z: out of the brain.
pose = np.eye(4)
pose[:3, :3] = np.column_stack([across, np.cross(-place.inward, across), -place.inward])
pose[:3, 3] = place.point + 2 * MM * place.inward

fem = Fem(anatomy, [Elasticity(), Held(), Bonded(), ToolContact((Ball(7 * MM),))], element="smoothed")
answer = fem.deform(Loads((Touching(pose[None, None]),)))  # (loads, tools, 4, 4)
(outcome,), felt = answer.outcome, float(answer.reaction[0, 0, :3] @ place.inward)
motion = np.linalg.norm(answer.displacement[0, anatomy.tumour_nodes].mean(axis=0)) / MM
print(f"{outcome.value}: {felt:.3f} N press the tumour {motion:.2f} mm away; {answer.cost.total:.2f} s")
assert outcome.good
assert 0.05 < felt < 0.07
