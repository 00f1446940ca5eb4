"""A simulated data set in PyTorch: from the force on a block of gel to the motion of an inclusion.

`simulate` writes loads and answers into an HDF5 file, and `read_dataset` reads it. A `TensorDataset` holds forces and
motions, a `DataLoader` shuffles them, and one linear layer is fitted: under one place, soft tissue is nearly linear.
"""

import numpy as np
import torch
from torch.utils.data import DataLoader, TensorDataset

from sim import Anatomy, Elasticity, Fem, Held, NodalForce, TetMesh, ToolForce, push
from surrogate import read_dataset, simulate

# A block of 60 x 60 x 40 mm, its bottom held, its top open; each cube of 10 mm is cut into six tetrahedra.
nodes = 0.01 * np.stack(np.meshgrid(range(7), range(7), range(5), indexing="ij"), axis=-1).reshape(-1, 3)
number = np.arange(len(nodes)).reshape(7, 7, 5)
corner = [number[i : 6 + i, j : 6 + j, k : 4 + k].ravel() for k in (0, 1) for j in (0, 1) for i in (0, 1)]
paths = [(0, 1, 3, 7), (0, 3, 2, 7), (0, 2, 6, 7), (0, 6, 4, 7), (0, 4, 5, 7), (0, 5, 1, 7)]
tets = np.concatenate([np.stack([corner[c] for c in path], axis=1) for path in paths])
inside = np.linalg.norm(nodes[tets].mean(axis=1) - [0.03, 0.03, 0.02], axis=1) < 0.012
mesh = TetMesh(nodes, tets, np.where(inside, 2, 1))  # 2 is the tumour's label
held = np.repeat((nodes[:, 2] == 0.0)[:, None], 3, axis=1)
gel = Anatomy(mesh, held, slide_normal=np.zeros_like(nodes), craniotomy=nodes[:, 2] > 0.039)

forces = 0.05 * np.random.default_rng(0).uniform(-1.0, 1.0, (48, 3)) - [0.0, 0.0, 0.1]
loads = push(np.array([0.03, 0.03, 0.04]), forces, footprint=10e-3)
fem = Fem(gel, [Elasticity(), Held(), ToolForce(), NodalForce()], device="cpu", element="p1")
simulate("gel.h5", fem, loads, {"what": "a block of gel, pressed in the middle of its top"})

data = read_dataset("gel.h5")
motion = 1e3 * data.read_displacement(gel.tumour_nodes).mean(axis=1)  # (loads, 3) [mm]
pairs = TensorDataset(torch.tensor(10.0 * forces, dtype=torch.float32), torch.tensor(motion))
training, fresh = torch.utils.data.random_split(pairs, [36, 12], torch.Generator().manual_seed(0))

torch.manual_seed(0)
layer = torch.nn.Linear(3, 3, bias=False)
adam = torch.optim.Adam(layer.parameters(), lr=0.02)
for _ in range(150):
    for force, moved in DataLoader(training, batch_size=12, shuffle=True):
        adam.zero_grad()
        torch.nn.functional.mse_loss(layer(force), moved).backward()
        adam.step()

force, moved = fresh[:]
error = float((layer(force).detach() - moved).norm(dim=1).mean() / moved.norm(dim=1).mean())
print(f"on 12 fresh loads the layer is off by {error:.1%} of the motion")
assert error < 0.02
