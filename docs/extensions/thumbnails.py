"""Images of the examples in docs/examples: `make thumbnails`, or `make thumbnails NAME=yeoh`.

Each script runs in an empty folder, and the function of its name draws its variables.
"""

import os
import runpy
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from unittest.mock import MagicMock

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image
from scipy.interpolate import LinearNDInterpolator

from scenes import Viewpoint, open_theatre
from sim import Bonded, Elasticity, Fem, Held, ToolForce, open_cortex, push
from sim.terms.laws.conformance import build_evaluator

HOUSE = Path(__file__).parents[2]
SIZE = (320, 224)  # Width and height of an image [pixel].
SITE = open_theatre(device="cpu")
BODY, NODES, CORTEX = SITE.anatomy, SITE.anatomy.mesh.nodes, open_cortex(SITE.anatomy)
PLACE, MODEL = CORTEX.place(right_mm=0, up_mm=0), SITE.models["series-gp"]


def draw_curve(ax, x, y, name, across, up, marks="o-"):
    """Draw a curve with a name and the labels of both axes."""
    ax.plot(x, y, marks, ms=4, label=name)
    ax.set(xlabel=across, ylabel=up)
    ax.locator_params(nbins=6)
    ax.legend()


def draw_image(ax, image):
    """Draw an image (H, W, 3) uint8."""
    ax.imshow(image)
    ax.axis("off")


def draw_section(ax, motion):
    """Draw the deformed section through the push, coloured by the motion (N, 3) [m]; the tumour in green."""
    right = np.cross(PLACE.inward, [0.0, 1.0, 0.0])
    frame = np.stack([right / np.linalg.norm(right), -PLACE.inward])
    flat = np.stack(np.meshgrid(np.linspace(-0.03, 0.03, 121), np.linspace(-0.038, 0.01, 97)), axis=-1)
    inside = np.isin(np.arange(len(NODES)), BODY.tumour_nodes)
    values = LinearNDInterpolator(NODES, np.column_stack([motion, inside]))(PLACE.point + flat @ frame)
    x, y = 1e3 * np.moveaxis(flat + np.nan_to_num(values[..., :3]) @ frame.T, -1, 0)
    shown = ax.pcolormesh(x, y, 1e3 * np.linalg.norm(values[..., :3], axis=-1), cmap="magma", shading="gouraud")
    ax.contour(x, y, values[..., 3], [0.5], colors="lime")
    ax.figure.colorbar(shown, label="motion [mm]")
    ax.set(aspect="equal", xticks=[], yticks=[])


def _own_scene(ax, it):
    """Draw the middle frame of a scene."""
    scene = replace(it.SCENE, viewpoint=Viewpoint(width=SIZE[0], height=SIZE[1]))
    *_, frame = SITE.build_player(SITE.select_best(scene), scene).play_frames(every=len(scene.times) // 2)
    draw_image(ax, frame.shown)


_sucker = _own_scene


def _compare_skulls(ax, it):
    for name, colour in (("bonded", "tab:blue"), ("slides", "tab:orange")):
        x, y = 1e3 * np.stack([CORTEX.right, -PLACE.inward]) @ getattr(it, name).T
        ax.quiver([0, 0.5], [0, 0], x, y, angles="xy", scale_units="xy", scale=1, color=colour, label=name)
    ax.set(xlim=(-0.2, 0.9), ylim=(-0.45, 0.05), xlabel="tumour motion to the right [mm]", ylabel="outwards [mm]")
    ax.legend()


def _inside_opencv(ax, it):
    draw_image(ax, it.picture[144:432, 101:513, ::-1])


def _into_pytorch(ax, it):
    for name, x, y in zip("xyz", it.moved.T, it.layer(it.force).detach().T, strict=True):
        draw_curve(ax, x, y, name, "motion by FEM [mm]", "by the layer [mm]", "o")


def _nearest(ax, it):
    across, fine = np.linspace(-12.0, 12.0, 13), np.linspace(-12.0, 12.0, 97)
    places = [CORTEX.place(right_mm=offset) for offset in across]
    loads = push(np.array([at.point for at in places]), np.array([0.2 * at.inward for at in places]), footprint=7e-3)
    motion = 1e3 * np.linalg.norm(MODEL.deform(loads, at=BODY.tumour_nodes).displacement.mean(axis=1), axis=1)
    predicted = it.Nearest().fit(across[:, None], motion[:, None]).predict(fine[:, None])
    for x, y, name, marks in ((across, motion, "training loads", "o"), (fine, predicted, "nearest", "-")):
        draw_curve(ax, x, y, name, "place of the push [mm]", "tumour motion [mm]", marks)


def _own_mesh(ax, it):
    u, side = 1e3 * it.answer.displacement[0], it.mesh.surface
    side = side[(it.mesh.nodes[side][..., 1] < 1e-6).all(axis=1)]
    x, _, y = (1e3 * it.mesh.nodes + 40.0 * u).T
    ax.triplot(*1e3 * it.mesh.nodes[:, ::2].T, side, color="silver", lw=0.6)
    shown = ax.tripcolor(x, y, side, -u[:, 2], shading="gouraud")
    ax.figure.colorbar(shown, label="sag [mm], drawn 40 times larger", orientation="horizontal")
    ax.set(aspect="equal", xlabel="length [mm]")


def _force_from_surface(ax, it):
    ax.bar(np.arange(3) - 0.2, it.truth, 0.4, color="silver", label="true")
    ax.bar(np.arange(3) + 0.2, it.force, 0.4, yerr=2 * it.deviation, label="found, 95 %")
    ax.set(xticks=range(3), xticklabels="xyz", ylabel="force [N]")
    ax.legend()


def _palpate_policies(ax, it):
    ax.bar(list(it.found), [total.mean() for total, _ in it.found.values()], color=["silver", "tab:blue", "tab:green"])
    ax.set(ylabel="mean return")


def _push_by_force(ax, it):
    draw_section(ax, it.fem.deform(push(PLACE.point, 0.1 * PLACE.inward, footprint=7e-3)).displacement[0])
    ax.annotate("0.1 N", (0, 0), (0, 14), arrowprops={"arrowstyle": "->"}, ha="center")


def _push_by_pose(ax, it):
    draw_section(ax, it.answer.displacement[0])
    ax.add_patch(plt.Circle((0, 5), 7, color="silver"))


def _read_episode(ax, it):
    near = np.where(it.last["depth"] > 0.0, (0.31 - it.last["depth"]) / 0.08, 0.0)
    depth = 255 * plt.get_cmap("viridis")(near)[..., :3]
    draw_image(ax, np.vstack([np.hstack([kind[0], kind[-1]]) for kind in (it.last["colour"], depth.astype(np.uint8))]))


def _recover_stiffness(ax, it):
    for name, found, truth in zip(("brain", "tumour"), 1e-3 * np.array(it.course).T, 1e-3 * it.truth, strict=True):
        draw_curve(ax, np.arange(len(found)), found, name, "iteration", "Young's modulus [kPa]")
        ax.axhline(truth, color="silver", lw=1, zorder=0)


def _slicer_console(ax, it):
    answer, now = MODEL.deform(push(PLACE.point, 0.3 * PLACE.inward, footprint=7e-3)), NODES.copy()
    now[answer.nodes] += answer.displacement[0]
    ax.axis("off")
    solid = ax.figure.add_axes((-0.3, -0.4, 1.6, 1.8), projection="3d")
    cortex, tumour = BODY.mesh.surface, BODY.tumour_surface
    for name, nodes, faces in (("CortexNow", now, cortex), ("TumourInScan", NODES, tumour), ("TumourNow", now, tumour)):
        solid.plot_trisurf(*nodes.T, triangles=faces, color=(*it.LOOKS[name][0], it.LOOKS[name][1]))
    solid.set_aspect("equal")
    solid.axis("off")


def _stiffness_sensitivity(ax, it):
    """Draw the section through the push."""
    right = np.cross(PLACE.inward, [0.0, 1.0, 0.0])
    frame = np.stack([right / np.linalg.norm(right), -PLACE.inward])
    flat = np.stack(np.meshgrid(np.linspace(-0.04, 0.04, 161), np.linspace(-0.055, 0.0, 111)), axis=-1)
    values = LinearNDInterpolator(it.centres, np.log10(it.image))(PLACE.point + flat @ frame)
    shown = ax.pcolormesh(*1e3 * np.moveaxis(flat, -1, 0), values, cmap="magma", vmin=-1.0, shading="gouraud")
    ax.figure.colorbar(shown, label="log10 of sensitivity [1/m2]")
    ax.set(aspect="equal", xticks=[], yticks=[])


def _veins(ax, it):
    cortex, forces = np.unique(BODY.open_surface), np.linspace(0.02, 0.2, 7)
    near = cortex[np.argsort(np.linalg.norm(NODES[cortex] - PLACE.point, axis=1))[:12]]
    loads = push(PLACE.point, forces[:, None] * PLACE.inward, footprint=7e-3)
    for name, own in (("free cortex", ()), ("12 veins", (it.Veins(tuple(near.tolist()), slack=5e-4),))):
        motion = Fem(BODY, (Elasticity(), Held(), Bonded(), ToolForce(), *own), device="cpu").deform(loads).displacement
        draw_curve(ax, forces, 1e3 * np.abs(motion).max(axis=(1, 2)), name, "force [N]", "largest motion [mm]")


def _yeoh(ax, it):
    shear = np.linspace(0.0, 1.2, 61)
    H = shear[:, None, None] * np.outer([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    for name, law in (("neo-Hookean (c2 = 0)", replace(it.SOFT, c2=0.0)), ("Yeoh", it.SOFT)):
        stress = build_evaluator(law, "float64")(H).stress[:, 0, 1] / 1e3
        draw_curve(ax, shear, stress, name, "shear", "shear stress [kPa]", "-")


if __name__ == "__main__":
    sys.modules["slicer"] = MagicMock()  # of 3D Slicer, which is not here
    plt.rcParams.update({"font.size": 8, "legend.fontsize": 7, "figure.constrained_layout.use": True})
    for script in sorted((HOUSE / "examples").glob(f"{sys.argv[1] if sys.argv[1:] else '*'}.py")):
        with TemporaryDirectory() as folder:
            os.chdir(folder)
            it = SimpleNamespace(**runpy.run_path(str(script), run_name="__main__"))
            figure, ax = plt.subplots(figsize=(3.2, 2.24), dpi=200)
            globals()[f"_{script.stem}"](ax, it)
            figure.savefig("drawn.png")
            image = Image.open("drawn.png").convert("RGB").resize(SIZE, Image.Resampling.LANCZOS)
            image.save(HOUSE / f"docs/examples/{script.stem}.webp", quality=85, method=6)
            os.chdir(HOUSE)
