"""Push by force: a tool presses, and the tumour moves.

The brain that ships is pressed once, by 0.1 N on a footprint of 7 mm in the middle of its open cortex. The finite
elements answer with the motion of every vertex; the mean over the tumour's is printed.
"""

from scenes import get_template_path
from sim import Bonded, Elasticity, Fem, Held, ToolForce, open_cortex, push, read_anatomy

MM = 1e-3

anatomy = read_anatomy(get_template_path())
place = open_cortex(anatomy).place(right_mm=0, up_mm=0)
fem = Fem(anatomy, [Elasticity(), Held(), Bonded(), ToolForce()], element="smoothed")
answer = fem.deform(push(place.point, 0.1 * place.inward, footprint=7 * MM), at=anatomy.tumour_nodes)

(outcome,), motion = answer.outcome, answer.displacement[0].mean(axis=0)  # (3,) [m, RAS]
inwards = motion @ place.inward / MM
print(f"{outcome.value}: the tumour goes {inwards:.2f} mm inwards; {answer.cost.total:.2f} s")
assert outcome.good
assert 0.3 < inwards < 0.4
