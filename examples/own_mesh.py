"""A mesh of your own: a beam from another program, bent by a force at its end.

Here meshio writes the file, as your mesher would. `read_mesh` reads it, an `Anatomy` says which nodes are fixed, and
`Nodal` says which are pulled. `sulcus solve` does the same where the file holds point data `fixed` and `force`.
"""

import meshio
import numpy as np

from sim import REFERENCE, Anatomy, Elasticity, Fem, Held, Loads, Material, Nodal, NodalForce, read_mesh

LENGTH, SIDE, YOUNG, FORCE = 0.1, 0.02, 1e5, 1e-3  # [m], [m], [Pa], [N]

# Cubes of 10 mm, each cut into six tetrahedra along paths from one corner to the opposite one. The file is in mm.
cells = (10, 2, 2)
grid = 10.0 * np.stack(np.meshgrid(*(range(n + 1) for n in cells), indexing="ij"), axis=-1).reshape(-1, 3)
number = np.arange(len(grid)).reshape([n + 1 for n in cells])
nx, ny, nz = cells
corner = [number[i : nx + i, j : ny + j, k : nz + k].ravel() for i in (0, 1) for j in (0, 1) for k in (0, 1)]
paths = [(0, 1, 3, 7), (0, 1, 5, 7), (0, 2, 3, 7), (0, 2, 6, 7), (0, 4, 5, 7), (0, 4, 6, 7)]
tets = np.concatenate([np.stack([corner[c] for c in path], axis=1) for path in paths])
meshio.write("beam.vtu", meshio.Mesh(grid, [("tetra", tets)]))

mesh = read_mesh("beam.vtu", unit="mm").mesh
x = mesh.nodes[:, 0]
fixed, end = x < 1e-6, x > LENGTH - 1e-6
beam = Anatomy(
    mesh,
    fixed=np.repeat(fixed[:, None], 3, axis=1),
    slide_normal=np.zeros_like(mesh.nodes),  # no skull
    craniotomy=np.zeros(len(x), bool),  # and no opening in it
)
force = np.zeros((1, len(x), 3))  # (loads, vertices, 3) [N]
force[0, end, 2] = -FORCE / end.sum()

tissue = Material("linear", young=YOUNG, poisson=0.3)
fem = Fem(beam, [Elasticity(tissue), Held(), NodalForce()], REFERENCE, device="cpu", element="p2")
answer = fem.deform(Loads((Nodal(force),)))

# Timoshenko's beam: bending, and shear with a factor of 5/6.
theory = FORCE * LENGTH**3 / (3 * YOUNG * SIDE**4 / 12) + FORCE * LENGTH * 2.6 / (5 / 6 * YOUNG * SIDE**2)
sunk = -answer.displacement[0, end, 2].mean()
print(f"{answer.outcome[0].value}: the end sinks {1e3 * sunk:.4f} mm, in theory {1e3 * theory:.4f} mm")
assert abs(sunk / theory - 1.0) < 0.03
