"""Is a prediction right? The finite elements tell its error without being solved to the end.

The model that ships predicts a random load. `certify` takes one step of the finite elements from the prediction: how
far the tumour moves in it estimates the error. Here a whole solution says what the error is in truth.
"""

import numpy as np

from scenes import find_scene, open_theatre
from sim import TRAIN, Fem
from surrogate import certify, draw

theatre = open_theatre(device="cpu")
scene = find_scene("press")
model = theatre.models[theatre.best(scene)]
tumour = theatre.anatomy.tumour_nodes
loads = draw("palpation", theatre.anatomy, count=1, seed=0)
predicted = model.deform(loads, at=tumour)

fem = Fem(theatre.anatomy, scene.effects, TRAIN, "cpu", element="smoothed", live=True)  # loads come one at a time
found = certify(fem, loads, predicted)
solved = fem.deform(loads, at=tumour)

(estimate,), (promised, _) = found.estimate, predicted.bound[:, 0]
error = float(np.linalg.norm(predicted.displacement - solved.displacement, axis=2).max())
print(f"the worst vertex is off by {1e6 * estimate:.1f} um, in truth {1e6 * error:.1f} um")
print(f"the model itself promised at most {1e6 * promised:.1f} um for 95 of 100 loads")
assert found.sound.all()
assert abs(estimate / error - 1.0) < 0.25
