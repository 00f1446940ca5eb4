"""Tumour motion by the same force in different heads: the template, fsaverage's inner skull, and a brain mask.

    python benchmarks/heads.py [--mask ch2bet.nii.gz] [--cover 3 10 25] [--sites central frontal ...] [--nodes N]

Every brain is scaled to 1,470 ml; a separate row has the mask's own size. At each site the same ball of 12 mm radius
is drawn at the same depth under the cortex, the skull is opened over it, and 0.3 N press the middle of the opening.
A row has the mean motion of the tumour's vertices [mm], with a bonded and with a sliding skull, as CSV. fsaverage
needs the extra `anatomies`.
"""

import argparse
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from sim import Bonded, Elasticity, Fem, Held, Slide, ToolForce, open_cortex, push
from sim.bodies.healthy_heads import build_masked_head, read_fsaverage_head
from sim.bodies.subject import MeshPlan, Subject, make_anatomy
from sim.bodies.template import SITES, HeadScaling, HealthyHead, Tumour, build_synthetic_subject, build_template_subject
from sim.errors import InputError

FORCE, FOOTPRINT = 0.3, 7e-3  # [N], [m]


def list_heads(mask: Path | None) -> dict[str, Callable[[Tumour], Subject]]:
    """Return the functions that build a subject with a tumour, by the name of the head."""
    volume = HeadScaling().volume
    found = {"template": build_template_subject, "fsaverage": partial(_drawn, read_fsaverage_head(volume))}
    if mask is not None:
        found |= {
            "mask": partial(_drawn, build_masked_head(mask, volume=volume)),
            "mask, own size": partial(_drawn, build_masked_head(mask)),
        }
    return found


def _drawn(healthy: HealthyHead, tumour: Tumour) -> Subject:
    return build_synthetic_subject(tumour, healthy)


def compute_motions(subject: Subject, nodes: int) -> list[float]:
    """Compute the mean motion [mm] of the tumour under the force, with a bonded and with a sliding skull."""
    anatomy = make_anatomy(subject, MeshPlan(nodes))
    place = open_cortex(anatomy).place(right_mm=0, up_mm=0)
    loads = push(place.point, FORCE * place.inward, footprint=FOOTPRINT)
    found = []
    for skull in (Bonded(), Slide()):
        fem = Fem(anatomy, (Elasticity(), Held(), skull, ToolForce()), device="cpu", element="smoothed")
        motion = fem.deform(loads).displacement[0][anatomy.tumour_nodes]
        found.append(1e3 * float(np.linalg.norm(motion, axis=1).mean()))
    return found


def main() -> None:
    """Print a row for each depth, site and head; a rejected tumour has its reason as the row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mask", type=Path)
    parser.add_argument("--cover", type=float, nargs="+", default=[10.0, 25.0], help="[mm]")
    parser.add_argument("--sites", nargs="+", choices=tuple(SITES), default=list(SITES))
    parser.add_argument("--nodes", type=int, default=5300)
    args = parser.parse_args()
    print("head,cover_mm,site,bonded_mm,sliding_mm")
    found = list_heads(args.mask)
    for cover, site, (name, draw) in product(args.cover, args.sites, found.items()):
        try:
            moved = ",".join(
                f"{value:.3f}" for value in compute_motions(draw(Tumour(cover=1e-3 * cover, site=site)), args.nodes)
            )
        except InputError as error:
            moved = f'"{error}",'
        print(f'"{name}",{cover:g},{site},{moved}', flush=True)


if __name__ == "__main__":
    main()
