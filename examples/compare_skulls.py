"""How does the skull hold the brain? Where the tumour goes depends on it, most of all where a tool drags.

Two pushes, one straight and one aside, are answered twice: by a brain that the meninges bond to the skull, and by one
that slides along it without friction. What is true lies between the two, and no finer mesh decides it.
"""

import numpy as np

from scenes import get_template_path
from sim import Bonded, Elasticity, Fem, Held, Slide, ToolForce, open_cortex, push, read_anatomy

anatomy = read_anatomy(get_template_path())
cortex = open_cortex(anatomy)
place = cortex.place(right_mm=0, up_mm=0)
aside = (place.inward + cortex.right) / np.linalg.norm(place.inward + cortex.right)
loads = push(place.point, 0.1 * np.array([place.inward, aside]), footprint=7e-3)


def motion(skull: Bonded | Slide) -> np.ndarray:
    """Compute the tumour's mean motion (loads, 3) [m]."""
    fem = Fem(anatomy, [Elasticity(), Held(), skull, ToolForce()], element="smoothed")
    answer = fem.deform(loads, at=anatomy.tumour_nodes)
    assert all(outcome.good for outcome in answer.outcome)
    return answer.displacement.mean(axis=1)


bonded, slides = motion(Bonded()), motion(Slide())
apart = np.linalg.norm(slides - bonded, axis=1) / np.linalg.norm(bonded, axis=1)
for name, load in (("straight", 0), ("aside", 1)):
    print(f"pushed {name}: {1e3 * bonded[load]} mm bonded, {1e3 * slides[load]} mm sliding, {apart[load]:.0%} apart")
assert apart[1] > 0.4
