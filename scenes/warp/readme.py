"""README of an export: content of the files, instructions to open the files, and limitations."""

from collections.abc import Sequence

from .images import WarpedImage
from .landmarks import CENTROID, DESCRIPTIONS, NEAREST, TUMOUR
from .places import INNER_WEIGHTS

# First part of the text.
INTRODUCTION = """sulcus warp: a deformed brain, for other programs
Research only. Not a medical device.

What moved it: {words}
The anatomy: {file}, digest {digest}. Its space is RAS (right, anterior, superior).
{trust}
"""

# Part of the text on the files.
FILES = """
FILES
field_resampling.nii.gz  for images. At each place now, where that tissue was: NIfTI, 5-D, intent 1006, mm, RAS.
field_modeling.nrrd      for points and meshes. At each place in the scan, where it is now: NRRD, mm, LPS.
{sequence}{images}{surfaces}README.txt, warp.json    this page, and its figures for programs.

HOW TO OPEN THEM
3D Slicer  Drag the whole folder into the window. Add the two fields as transforms.
           Images: put your MRI under field_resampling in the Data module; it bends as you look.
           Points: put markups under field_modeling. Then harden the transform to keep what you see.
           Slicer knows the space of each mesh and each point by what is written in it.
ITK        import SimpleITK as sitk
           field = sitk.ReadImage("field_resampling.nii.gz", sitk.sitkVectorFloat64)
           now = sitk.Resample(mri, mri, sitk.DisplacementFieldTransform(field), sitk.sitkLinear, 0.0)
ANTs       antsApplyTransforms -d 3 -i mri.nii.gz -r mri.nii.gz -t field_resampling.nii.gz -o now.nii.gz
Others     VTP and STL are in millimetres, LPS: x to the patient's left, y to the back, z to the head.
           deformed.glb is in metres: x to the patient's left, y to the head, z to the front.
"""

# Part of the text on limitations.
LIMITS = """
WHAT IS NOT KNOWN
Only the brain was computed. Skull, air and skin were not: there the fields are no prediction.
Outside the brain they go on from its surface, and fade to zero within {reach:.0f} mm. So an image shows no tear
there. Bone above an opening may seem to move: it does not.
A voxel whose source lies outside the image, or in tissue that was cut away, is 0.
What moves by less than {faint:.3g} mm is left where it is.
{fold}
How far the fields, read between their nodes ({spacing:g} mm apart), are from the finite elements [mm]:
            95 of 100   worst
tumour      {tumour[p95]:9.3f}   {tumour[worst]:5.3f}
open cortex {cortex[p95]:9.3f}   {cortex[worst]:5.3f}
what moves  {moved:9.3f}   {worst:5.3f}
That is over the mesh's vertices and {between} places in each tetrahedron, the farther one of both fields at each. The
median is {median:.4f} mm. From "in the scan" field_modeling leads each landmark to "now" within {landmarks:.3f} mm.
These are errors of the grid. How far the tumour may be off: {bound}
"""


def write_readme(report: dict, images: Sequence[WarpedImage]) -> str:
    """Return the text of README.txt; `report` contains the results of an export, see `collect_figures`."""
    sequence = (
        "field_sequence.seq.nrrd  the same of many moments, which Slicer plays.\n" if report["sequence_frames"] else ""
    )
    lines = ""
    for one in images:
        lines += f"{one.name}\n    your image now, on its own grid: {one.moved:,} voxels moved.\n"
        lines += f"    0 as their source lies outside: {one.outside:,}; as it was resected: {one.resected:,}.\n"
    named = [*report["landmarks"], *([CENTROID] if {TUMOUR, NEAREST} & {*report["landmarks"]} else [])]
    points = "".join(f"    {name}: {DESCRIPTIONS[name]}\n" for name in named)
    surfaces = (
        "brain, cortex, tumour    .vtp, .stl, and all together deformed.glb: the deformed surfaces.\n"
        "landmarks.mrk.json       points, in the scan and now:\n"
        f"{points}"
        "tip_to_tumour.mrk.json   the line from the tip to the tumour's nearest point, where there is a tool.\n"
        "tumour.seg.nrrd          the tumour, and if it is known the shell in which its surface may lie.\n"
    )
    error = report["grid_error_mm"]
    limits = LIMITS.format(
        reach=report["reach_mm"],
        spacing=report["spacing_mm"],
        fold=_describe_folds(report),
        median=error["median"],
        moved=error["moved_p95"],
        worst=error["worst"],
        tumour=error["tumour"],
        cortex=error["cortex"],
        between=len(INNER_WEIGHTS),
        faint=report["faint_mm"],
        landmarks=error["landmarks_worst"],
        bound=_describe_bound(report),
    )
    failed = [] if report["converged"] else ["THE SOLUTION DID NOT CONVERGE: do not rely on it."]
    trust = "\n".join([*failed, *(f"WARNING: {warning}" for warning in report["warnings"])])
    start = INTRODUCTION.format(words=report["moved_by"], trust=trust, **report["anatomy"])
    return start + FILES.format(sequence=sequence, images=lines, surfaces=surfaces) + limits


def _describe_folds(report: dict) -> str:
    shares = report["least_jacobian"]
    least = ", ".join(f"{value:.3f}" for value in shares.values())
    said = f"Least volume that is left, as a share (modeling, resampling, tetrahedra): {least}."
    if report["fields_fold"]:
        return f"{said} THE FIELDS ARE NOT ABOVE 0: SPACE FOLDS, and what lies there is not to be relied on."
    if report["folds"]:
        return f"{said} The fields are above 0. Where the finite elements fold, see WARNING above, they were unfolded."
    return f"{said} All are above 0: nothing folds."


def _describe_bound(report: dict) -> str:
    if report["bound_mm"] is None:
        return f"not known ({report['bound_of']})."
    return f"with 95 %, no point of it by more than {report['bound_mm']:.1f} mm. Of: {report['bound_of']}."
