"""Pages of markers: printed size, corner positions and the net of the cube."""

import io
import re

import cv2
import numpy as np
import pytest
from PIL import Image

from ar.tracking.pages import PrintedPage, build_printed_pages, describe_targets, to_face_name, to_pdf, to_png
from ar.tracking.targets import BORDER_WIDTH, build_calibration_board, build_patient_reference, build_tool_cube


@pytest.fixture(scope="module")
def pages():
    return build_printed_pages()


def drawn_in_pdf(content):
    """Each page of a PDF whose pages are one picture each: the picture (H, W), and its size on paper (2,) [mm]."""
    form = rb"/Width (\d+)\n/Height (\d+)\n/Filter \[ /CCITTFaxDecode \]\n.*?/Length (\d+)\n>>stream\n"
    sizes = re.findall(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", content)
    matrices = re.findall(rb"q ([\d.]+) 0 0 ([\d.]+) 0 0 cm /image Do Q", content)
    for head, size, matrix in zip(re.finditer(form, content, re.DOTALL), sizes, matrices, strict=True):
        np.testing.assert_allclose(np.array(size, float), np.array(matrix, float), atol=1e-5)  # it fills the page
        width, height, length = map(int, head.groups())
        # As a TIFF with nothing but its data: width, height, bits, Group 4, 1 is white, start, rows, length.
        tags = [(256, width), (257, height), (258, 1), (259, 4), (262, 1), (273, 8), (278, height), (279, length)]
        data = content[head.end() : head.end() + length] + bytes(length % 2)
        table = len(tags).to_bytes(2, "little")
        for tag, value in tags:
            table += tag.to_bytes(2, "little") + b"\4\0\1\0\0\0" + value.to_bytes(4, "little")
        tiff = b"II*\0" + (8 + len(data)).to_bytes(4, "little") + data + table + bytes(4)
        yield np.asarray(Image.open(io.BytesIO(tiff)).convert("L")), np.array(size, float) / 72.0 * 25.4


def test_pdf_and_png_pages_have_equal_pixels_and_size(pages):
    content = to_pdf(pages)
    found = list(drawn_in_pdf(content))
    assert [page.name for page in pages] == ["tool", "patient", "board"] and len(found) == 3
    for page, (pixels, size) in zip(pages, found, strict=True):
        np.testing.assert_array_equal(pixels, page.pixels)
        np.testing.assert_allclose(sorted(size), [210.0, 297.0], atol=1e-6)
        with Image.open(io.BytesIO(to_png(page))) as picture:
            np.testing.assert_array_equal(np.asarray(picture.convert("L")), page.pixels)
            mm = np.array(picture.size) / np.array(picture.info["dpi"]) * 25.4
        np.testing.assert_allclose(mm, size, atol=1e-6)


def edges(line):
    """Where a row or column of pixels changes [pixel]."""
    return np.flatnonzero(np.diff(line.astype(int))) + 1


@pytest.mark.parametrize("number", range(3))
def test_squares_and_markers_have_nominal_printed_size(pages, number):
    """Size from the PNG's dots per inch, along the first row and column of squares and through a marker."""
    page = pages[number]
    with Image.open(io.BytesIO(to_png(page))) as picture:
        pixels, per_mm = np.asarray(picture.convert("L")), picture.info["dpi"][0] / 25.4
    for each in page.faces:
        face = each.face
        left, top = (round(at * per_mm) for at in (each.left, each.top))
        wide, high = (round(1e3 * size * per_mm) for size in face.size)
        box = pixels[top - 20 : top + high + 20, left - 20 : left + wide + 20]
        for line, count in ((box[22], face.columns), (box[:, 22], face.rows)):  # in the margin of the markers
            assert len(edges(line)) == count + 1
            np.testing.assert_allclose(np.diff(edges(line)) / per_mm, 1e3 * face.square, atol=1e-9)
        second = np.rot90(box, each.quarter_turns)[20 : 20 + round(1e3 * face.square * per_mm), :]
        across = edges(second[len(second) // 8 + 4, 20 + len(second) : 20 + 2 * len(second)])  # a marker's border
        assert np.diff(across) / per_mm == pytest.approx(750.0 * face.square)


def test_printed_rulers_are_100_mm_long(pages):
    for page in pages:
        black = page.pixels == 0
        right, down = ([edges(line) for line in side] for side in (black, black.T))
        for lines in (right, down):  # somewhere, marks every 10 mm
            marks = [line[:-1:2] for line in lines if len(line) >= 22]
            assert any(
                (np.diff(starts[at : at + 11]) == 200).all() for starts in marks for at in range(len(starts) - 10)
            )


@pytest.mark.parametrize("number", range(3))
def test_opencv_detects_corners_at_their_page_positions(pages, number):
    page = pages[number]
    small = cv2.resize(page.pixels, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    for each in page.faces:
        corners, ids, _, markers = cv2.aruco.CharucoDetector(each.face.board).detectBoard(small)
        assert set(each.face.ids) <= set(np.asarray(markers).ravel())
        own = np.asarray(each.face.board.getChessboardCorners())[np.asarray(ids).ravel(), :2]
        assert len(own) == (each.face.columns - 1) * (each.face.rows - 1)
        seen = 0.2 * (np.asarray(corners).reshape(-1, 2) + 0.5)
        np.testing.assert_allclose(seen, on_paper(each, 1e3 * own), atol=0.05)


def on_paper(each, places):
    """Places (n, 2) [mm] on a face, as they lie on its page."""
    size = 1e3 * each.face.size
    around = places - 0.5 * size
    for _ in range(each.quarter_turns):
        around = np.column_stack([-around[:, 1], around[:, 0]])
    return around + 0.5 * size + [each.left, each.top]


def test_adjacent_faces_on_paper_are_adjacent_on_the_cube(pages):
    """Border corners at one place of the net coincide in space; a tab joins the remaining edge."""
    spots = []
    for each in pages[0].faces:
        T, size, border = each.face.T_target_face, each.face.size, BORDER_WIDTH
        square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (size + 2.0 * border) - border
        space = 1e3 * (square @ T[:3, :2].T + T[:3, 3])
        assert abs(space).max() == pytest.approx(24.0)
        spots += list(zip(on_paper(each, 1e3 * square), space, strict=True))
    shared = [
        (one, other)
        for index, (paper, one) in enumerate(spots)
        for again, other in spots[:index]
        if np.allclose(paper, again)
    ]
    assert len(shared) == 5  # two folds, whose ends meet in one place of the paper three times
    for one, other in shared:
        np.testing.assert_allclose(one, other, atol=1e-9)
    names = {to_face_name(each.face): each for each in pages[0].faces}
    assert (names["+z"].left, names["+z"].top + 48.0) == (names["+x"].left, names["+x"].top)
    assert (names["+y"].left - 48.0, names["+y"].top) == (names["+x"].left, names["+x"].top)


def test_cut_lines_surround_the_face_borders(pages):
    """Most of each outer side of net and plate is drawn, and nothing in the white area between."""
    for page, names in ((pages[0], "+z"), (pages[1], "-z")):
        (each,) = [each for each in page.faces if to_face_name(each.face) == names]
        left, top = (round(20.0 * (at - 1e3 * BORDER_WIDTH)) for at in (each.left, each.top))
        wide = round(2e4 * (each.face.size[0] + 2.0 * BORDER_WIDTH))
        side = page.pixels[top : top + wide, left - 2 : left + 3] == 0
        assert 0.4 < side.any(axis=1).mean() < 0.7
        assert (page.pixels[top + 200 : top + wide - 5, left + 5 : left + 75] == 255).all()


def test_target_list_describes_the_printed_targets():
    listed = describe_targets()
    assert listed["dictionary"] == "DICT_4X4_250" and listed["nominal_tip_mm"] == {"tool": [0.0, 0.0, -150.0]}
    targets = (build_tool_cube(), build_patient_reference(), build_calibration_board())
    assert [each["name"] for each in listed["targets"]] == [target.name for target in targets]
    assert [face["name"] for face in listed["targets"][0]["faces"]] == ["+x", "+y", "+z"]
    every = []
    for each, target in zip(listed["targets"], targets, strict=True):
        for row, face in zip(each["faces"], target.faces, strict=True):
            np.testing.assert_allclose(row["corners_mm"], 1e3 * face.corners, atol=1e-6)
            np.testing.assert_allclose(row["outline_mm"], 1e3 * face.outline, atol=1e-6)
            assert row["marker_mm"] == pytest.approx(0.75 * row["square_mm"])
            every += row["ids"]
    assert every == list(range(79))


def test_page_pixels_are_black_or_white(pages):
    assert all(isinstance(page, PrintedPage) and set(np.unique(page.pixels)) == {0, 255} for page in pages)
