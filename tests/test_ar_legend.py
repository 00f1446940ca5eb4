"""Legend: it names lines and leaves the cortex visible."""

import numpy as np
from test_ar_styles import CAMERA, DRAPE, GREEN, OPENING, seen, tumour

from ar.overlay.composite import composite
from ar.overlay.hud import HEAD_ROW
from ar.overlay.legend import SHEET_VALUE, LegendNames
from ar.overlay.marks import ImageText, Marks, Occluders
from ar.overlay.outlines import average_colour, find_colour


def test_legend_names_lines_and_does_not_cover_the_cortex():
    picture, at = seen(0.0), tumour()
    names = LegendNames("it", "its error", "before")
    plain, named = (
        composite(
            picture,
            CAMERA,
            at,
            cover=Occluders(opening=OPENING),
            marks=Marks(0.003, initial=at),
            words=ImageText(legend=each),
        ).colour
        for each in (LegendNames(), names)
    )
    changed = (plain != named).any(axis=2)
    assert changed.sum() > 500 and (picture.segmentation[changed] == DRAPE).all()
    assert not find_colour(named, average_colour(GREEN))[changed].any()
    crowded = composite(
        seen(),
        CAMERA,
        at,
        cover=Occluders(opening=OPENING),
        marks=Marks(0.003, initial=at),
        words=ImageText(legend=names),
    ).colour
    without = composite(seen(), CAMERA, at, cover=Occluders(opening=OPENING), marks=Marks(0.003, initial=at)).colour
    assert np.array_equal(crowded, without)  # there is cortex everywhere: no room


def test_section_inset_leaves_bottom_rows_for_text():
    covered = np.zeros((480, 640), bool)
    covered[:270, 400:] = True  # the inset stands low
    over = composite(
        seen(0.01),
        CAMERA,
        tumour((0.0, 0.0, -0.014)),
        style="cut",
        cover=Occluders(opening=OPENING, occluder_mask=covered),
    )
    assert (over.taken == SHEET_VALUE).any() and not (over.taken[-HEAD_ROW:] == SHEET_VALUE).any()
