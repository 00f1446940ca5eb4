"""Specification of the arrays of an episode: axes, types and units, in the current and in the former format."""

from collections.abc import Mapping
from dataclasses import dataclass

FORMATS = ("sulcus episode 1", "sulcus episode 2")  # Supported file formats.
COLOUR, DEPTH, LABELS = "colour", "depth", "labels"  # Decoders of images.
FRAMES, SOLVED = "frames", "solved"  # Names of array axes: frames, frames solved by FEM.


@dataclass(frozen=True)
class ArraySpec:
    """Specification of an array of an episode.

    Parameters
    ----------
    axes
        Lengths of the axes, or names of lengths that arrays share; None at the end: any number of further axes.
    kind
        Allowed letters of NumPy's `dtype.kind`; "O" for texts or images.
    unit
        Required unit in the array's attribute; None: no unit is required.
    known
        True if NaN (not available) is not allowed.
    limited
        True if infinite values are not allowed; the bound of a load outside the training range is infinite.
    """

    axes: tuple[int | str | None, ...]
    kind: str = "f"
    unit: str | None = "m"
    known: bool = True
    limited: bool = True

    @property
    def has_frame_axis(self) -> bool:
        """True if the array has a row for each frame."""
        return bool(self.axes) and self.axes[0] == FRAMES


PICTURES: Mapping[str, str] = {
    "colour": COLOUR,
    "colour_right": COLOUR,
    "overlay": COLOUR,
    "depth": DEPTH,
    "segmentation": LABELS,
    "tumour_mask": LABELS,
}
"""Decoder of each kind of image by name; an episode has one image per frame in the group `pictures`."""


def get_suffix(name: str) -> str:
    """Return the file ending of an encoded image: jpg for colour, else png."""
    return "jpg" if PICTURES[name] == COLOUR else "png"


_POSE = ArraySpec((FRAMES, 4, 4))  # Pose of a body.
_PLACE = ArraySpec((FRAMES, 3), known=False)  # Position, which may be unknown.
_ERROR = ArraySpec((FRAMES,), known=False, limited=False)  # Error bound, which may be unknown or infinite.
_FORCE = ArraySpec((FRAMES, 3), unit="N", known=False)  # Force [N], which may be unknown.

ARRAYS: Mapping[str, ArraySpec] = {
    "time": ArraySpec((FRAMES,), unit="s"),
    "seconds": ArraySpec((FRAMES, "stages"), unit="s"),
    "K": ArraySpec((3, 3), unit="pixel"),
    "K_of_frame": ArraySpec((FRAMES, 3, 3), unit="pixel"),
    "distortion": ArraySpec((8,), unit="1"),
    "T_camera_world": _POSE,
    "T_camera_world_tracked": ArraySpec((FRAMES, 4, 4), known=False),
    "T_camera_world_right": _POSE,
    "T_world_tool": _POSE,
    "T_world_tool_tracked": ArraySpec((FRAMES, 4, 4), known=False),
    "force": _FORCE,
    "force_read": _FORCE,
    "contact": _PLACE,
    "tip": ArraySpec((FRAMES, 3)),
    "distance": ArraySpec((FRAMES,), known=False),
    "distance_error": _ERROR,
    "bound": ArraySpec((FRAMES, 2), known=False, limited=False),
    "model_error": _ERROR,
    "tumour_error": _ERROR,
    "tumour_error_unobserved": _ERROR,
    "reaction_predicted": ArraySpec((FRAMES, "tools", 6), unit="N, N m", known=False),
    "reaction_fem": ArraySpec((SOLVED, "tools", 6), unit="N, N m"),
    "reaction_bound": ArraySpec((FRAMES, 2), unit="N", known=False, limited=False),
    "direction": ArraySpec((FRAMES, 3), unit="1"),
    "csf_level": ArraySpec((FRAMES,)),
    "share": ArraySpec((FRAMES,), unit="1"),
    "done": ArraySpec((FRAMES,), "iuf", "1"),
    "pose": ArraySpec((FRAMES, None)),
    "displacement": ArraySpec((FRAMES, None)),
    "fem_frames": ArraySpec((SOLVED,), "iu", "1"),
    "outcome_predicted": ArraySpec((FRAMES,), "O", "text"),
    "outcome_fem": ArraySpec((SOLVED,), "O", "text"),
    "tumour_predicted": ArraySpec((FRAMES, "tumour", 3)),
    "tumour_fem": ArraySpec((SOLVED, "tumour", 3)),
    "tumour_left": ArraySpec((FRAMES, "tumour"), "b", "1"),
    "tumour_nodes": ArraySpec(("tumour",), "iu", "1"),
    "tumour_rest": ArraySpec(("tumour", 3)),
    "cortex_predicted": ArraySpec((FRAMES, "cortex", 3)),
    "cortex_fem": ArraySpec((SOLVED, "cortex", 3)),
    "cortex_nodes": ArraySpec(("cortex",), "iu", "1"),
    "cortex_rest": ArraySpec(("cortex", 3)),
}
"""Specifications of arrays other than images, by name; only `time` is required."""

REQUIRED_ARRAYS = ("time",)  # Required arrays.
