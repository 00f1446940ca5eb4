"""One head in files of every format and convention, on one grid or several: the same brain, or an error message."""

import gzip
import re
import struct
from dataclasses import replace

import nibabel
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim.bodies.head_masks import MaskSources, read_head_masks
from sim.bodies.label_volume import build_masked_subject, build_volume_subject
from sim.bodies.subject import MeshPlan, SubjectPart, make_anatomy
from sim.bodies.volume import read_volume
from sim.bodies.voxels import VoxelSpec
from sim.errors import InputError

LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
EDGE = 3.0  # [mm]
MIDDLE, TUMOUR = np.array([20.0, 40.0, 10.0]), np.array([38.0, 48.0, 25.0])  # [mm, RAS]
TURNED = Rotation.from_euler("xyz", [12, -9, 17], degrees=True).as_matrix()
AXES = {"straight": np.eye(3), "mirrored": np.diag([-1.0, 1.0, 1.0]), "oblique": TURNED @ np.diag([1.0, -1.0, 1.0])}


def grid(axes=AXES["straight"], edge=EDGE, count=40, middle=MIDDLE):
    """Affine [mm] of a cube of voxels round a place, and where each voxel lies (I, J, K, 3) [mm]."""
    affine = np.eye(4)
    affine[:3, :3] = edge * axes
    affine[:3, 3] = middle - edge * axes @ np.full(3, 0.5 * (count - 1))
    index = np.moveaxis(np.indices((count,) * 3), 0, -1)
    return affine, index @ affine[:3, :3].T + affine[:3, 3]


def head(places, brain=1, tumour=3):
    """An ellipsoid with a ball in it."""
    labels = np.where(np.linalg.norm((places - MIDDLE) / [46.0, 55.0, 42.0], axis=-1) < 1.0, brain, 0)
    labels[np.linalg.norm(places - TUMOUR, axis=-1) < 12.0] = tumour
    return labels.astype(np.int16)


def nifti(path, values, affine):
    nibabel.save(nibabel.Nifti1Image(values, affine), path)
    return path


def mgz(path, values, affine):
    nibabel.save(nibabel.MGHImage(values, affine), path)
    return path


def nrrd(path, values, affine, space="left-posterior-superior", more="", coding="gzip", signs=LPS, leave_out=()):
    """Voxels (I, J, K) or (L, I, J, K) as an NRRD file whose axes are those of `space`, by `signs` from RAS."""
    placed = signs @ affine
    vectors = [f"({','.join(map(repr, column))})" for column in placed[:3, :3].T.tolist()]
    fields = {
        "type": {"int16": "short", "uint8": "uint8", "float32": "float"}[values.dtype.name],
        "dimension": values.ndim,
        "space": space,
        "sizes": " ".join(map(str, values.shape)),
        "space directions": " ".join(["none"] * (values.ndim - 3) + vectors),
        "endian": "little",
        "encoding": coding,
        "space origin": f"({','.join(map(repr, placed[:3, 3].tolist()))})",
    }
    text = "NRRD0004\n# a comment\n" + "".join(f"{k}: {v}\n" for k, v in fields.items() if k not in leave_out)
    raw = values.tobytes(order="F")
    path.write_bytes((text + more + "\n").encode() + (gzip.compress(raw) if coding == "gzip" else raw))
    return path


def segments(*named):
    """Keys of 3D Slicer: names with their layers and label values."""
    return "".join(
        f"Segment{n}_ID:=Segment_{n}\nSegment{n}_Name:={name}\nSegment{n}_Layer:={layer}\nSegment{n}_LabelValue:={value}\n"
        for n, (name, layer, value) in enumerate(named)
    )


def seg_nrrd(path, values, affine):
    """Brain and tumour in layers that overlap."""
    layers = np.stack([values > 0, values == 3]).astype(np.uint8)
    return nrrd(path, layers, affine, more=segments(("Whole brain", 0, 1), ("Tumour", 1, 1)))


WRITERS = {
    "labels.nii.gz": nifti,
    "labels.mgz": mgz,
    "labels.nrrd": nrrd,
    "raw.nrrd": lambda *given: nrrd(*given, coding="raw"),
    "ras.nrrd": lambda *given: nrrd(*given, space="RAS", signs=np.eye(4)),
    "las.nrrd": lambda *given: nrrd(*given, space="left-anterior-superior", signs=np.diag([-1.0, 1.0, 1.0, 1.0])),
    "labels.seg.nrrd": seg_nrrd,
}


@pytest.mark.parametrize("axes", AXES)
@pytest.mark.parametrize("name", WRITERS)
def test_head_mesh_is_independent_of_the_file_format(tmp_path, name, axes):
    affine, places = grid(AXES[axes])
    path = WRITERS[name](tmp_path / name, head(places), affine)
    named = ("Whole brain",), ("tumour",)
    subject = build_volume_subject(path, *(named if name.endswith(".seg.nrrd") else ((1,), (3,))))
    assert subject.notes == ()
    within = head(places) > 0
    np.testing.assert_allclose(subject.cortex.min(axis=0), 1e-3 * places[within].min(axis=0), atol=1e-6)
    np.testing.assert_allclose(subject.cortex.max(axis=0), 1e-3 * places[within].max(axis=0), atol=1e-6)
    assert np.linalg.norm(subject.pieces[0].centre - 1e-3 * TUMOUR) < 1e-3 * EDGE / 4
    assert subject.tumour_volume == pytest.approx((head(places) == 3).sum() * (1e-3 * EDGE) ** 3, rel=1e-5)
    points = 1e-3 * (MIDDLE + np.random.default_rng(0).uniform(-70.0, 70.0, (200, 3)))
    assert (
        (subject.brain(points) < 0.0) == (np.linalg.norm((1e3 * points - MIDDLE) / [46, 55, 42], axis=1) < 1)
    ).mean() > 0.95


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"leave_out": ("space",)}, "does not state its space, so its left side is unknown"),
        ({"space": "scanner-xyz"}, "its space is 'scanner-xyz'"),
        ({"leave_out": ("space origin",)}, "does not state its space origin"),
        ({"leave_out": ("space directions",)}, "does not state its space directions"),
        ({"leave_out": ("endian",)}, "does not state its endian"),
        ({"more": 'space units: "inch" "inch" "inch"\n'}, "its space units are"),
        ({"coding": "hex"}, "coded as 'hex': must be raw, gzip or bzip2"),
        ({"more": "data file: voxels.raw\n"}, "has its voxels in 'voxels.raw', and no such file is in the same folder"),
        ({"more": "data file: LIST\n"}, "no such file is in the same folder"),
        ({"more": "datafile: ../voxels.raw\n"}, r"in '\.\./voxels.raw', and only a file in the same folder is read"),
        ({"more": "data file: /etc/passwd\n"}, "only a file in the same folder is read"),
        ({"more": "data file: sub\\\\voxels.raw\n"}, "only a file in the same folder is read"),
        ({"more": "data file: ..\n"}, "only a file in the same folder is read"),
        ({"more": "byte skip: 16\n"}, "skips bytes"),
    ],
)
def test_incomplete_nrrd_header_is_rejected(tmp_path, change, reason):
    affine, places = grid()
    with pytest.raises(InputError, match=reason):
        read_volume(nrrd(tmp_path / "a.nrrd", head(places), affine, **change))


@pytest.mark.parametrize("coding", ["gzip", "raw"])
def test_damaged_nrrd_file_is_rejected(tmp_path, coding):
    affine, places = grid(count=12, edge=6.0)
    whole = nrrd(tmp_path / "a.nrrd", head(places), affine, coding=coding, more=segments(("A", 0, 1))).read_bytes()
    path = tmp_path / "b.nrrd"
    for place in range(0, len(whole), 11):
        for spoilt in (whole[:place], whole[:place] + bytes([whole[place] ^ 255]) + whole[place + 1 :]):
            path.write_bytes(spoilt)
            try:
                read_volume(path)
            except InputError as error:
                assert str(error).startswith(str(path)) and "Error -" not in str(error)
    path.write_bytes(whole.replace(b"sizes: 12 12 12", b"sizes: 800 800 800"))
    with pytest.raises(
        InputError, match=r"ends after .* of 1,024,000,000 bytes|is too short for its 1,024,000,000 bytes"
    ):
        read_volume(path)
    path.write_bytes(whole.replace(b"sizes: 12 12 12", b"sizes: 9999 999 999"))
    with pytest.raises(InputError, match=r"9\.98e\+09 voxels; the maximum is 5\.37e\+08"):
        read_volume(path)


def test_freesurfer_volume_without_orientation_is_rejected(tmp_path):
    affine, places = grid()
    path = mgz(tmp_path / "a.mgz", head(places), affine)
    raw = bytearray(gzip.decompress(path.read_bytes()))
    struct.pack_into(">h", raw, 28, 0)
    path.write_bytes(gzip.compress(bytes(raw)))
    with pytest.raises(InputError, match="does not state how its axes lie in the head"):
        read_volume(path)
    path.write_bytes(gzip.compress(bytes(raw[:5000])))
    with pytest.raises(InputError, match=r"ends after 5,000 of \d+,\d+ bytes"):
        read_volume(path)


@pytest.mark.parametrize(("name", "layers"), [("Segmentation", 1), ("SegmentationOverlapping", 2)])
def test_slicer_segmentation_agrees_with_reference_reader(name, layers):
    slicerio = pytest.importorskip("slicerio")
    import nrrd as reference

    path = slicerio.get_testdata_file(f"{name}.seg.nrrd")
    values, header = reference.read(path)
    found = read_volume(path, VoxelSpec(max_edge=0.011), allow_layers=True)
    expected = np.moveaxis(values, 0, -1) if layers > 1 else values
    np.testing.assert_array_equal(found.values, expected)
    np.testing.assert_allclose(1e3 * found.affine[:3, 3], header["space origin"] * [-1, -1, 1])
    np.testing.assert_allclose(1e3 * found.affine[:3, :3], LPS[:3, :3] @ header["space directions"][-3:].T)
    assert [one.name for one in found.segments[4:6]] == ["right lung", "left lung"]
    right, left = (
        np.argwhere(expected.reshape(*expected.shape[:3], -1)[..., 0] == label).mean(axis=0) for label in (5, 6)
    )
    assert found.affine[0, :3] @ right > found.affine[0, :3] @ left
    if layers > 1:
        assert (found.segments[7].name, found.segments[7].layer) == ("overlapping sphere", 1)
        with pytest.raises(InputError, match=r"its segments overlap, in 2 layers.*Export them as a label map"):
            read_volume(path, VoxelSpec(max_edge=0.011))


def test_segments_are_selected_by_their_names(tmp_path):
    affine, places = grid()
    path = seg_nrrd(tmp_path / "a.seg.nrrd", head(places), affine)
    with pytest.raises(InputError, match=r"has no label Tumor. Choose from Whole brain, Tumour\."):
        build_volume_subject(path, ("Whole brain",), ("Tumor",))
    with pytest.raises(InputError, match="several segments have the label 1: name one of Tumour, Whole brain"):
        build_volume_subject(path, (1,), ("Tumour",))
    with pytest.raises(InputError, match="label Tumour is named by --brain and by --tumour"):
        build_volume_subject(path, ("Whole brain", "tumour"), ("Tumour",))


def test_segments_with_equal_names_require_numbers(tmp_path):
    affine, places = grid()
    named = segments(("Brain", 0, 1), ("Tumou\u0301r", 0, 4), ("Tumo\u00far", 0, 3))
    labels = head(places)
    labels[(labels == 3) & (places[..., 0] > TUMOUR[0])] = 4
    path = nrrd(tmp_path / "a.seg.nrrd", labels, affine, more=named)
    with pytest.raises(InputError, match="several segments are called tumo\u00far: give its number, of 3, 4"):
        build_volume_subject(path, ("Brain",), ("tumo\u00far",))  # composed or not, they are one name
    assert build_volume_subject(path, ("Brain",), (3, 4)).notes == ()


class TestSeveralFiles:
    @pytest.fixture
    def files(self, tmp_path):
        """A mask that is oblique and coarse, and a tumour on a small and fine grid of its own."""
        affine, places = grid(AXES["oblique"], edge=3.5, count=40)
        nifti(tmp_path / "brain.nii.gz", (100.0 * (head(places) > 0)).astype(np.float32), affine)
        affine, places = grid(AXES["mirrored"], edge=2.0, count=16, middle=TUMOUR + 1.0)
        nifti(tmp_path / "tumour.nii.gz", (head(places) == 3).astype(np.int16), affine)
        return tmp_path

    def test_mask_on_another_grid_extends_the_labels(self, files):
        sources = MaskSources(files / "tumour.nii.gz", tumour=(1,), mask=files / "brain.nii.gz")
        subject = build_masked_subject(read_head_masks(sources))
        assert subject.notes == ()
        assert np.linalg.norm(subject.pieces[0].centre - 1e-3 * TUMOUR) < 5e-4
        low, high = 1e3 * subject.cortex.min(axis=0), 1e3 * subject.cortex.max(axis=0)
        np.testing.assert_allclose([low, high], MIDDLE + np.outer([-1, 1], [46.0, 55.0, 42.0]), atol=3.5)

    def test_tumour_is_read_from_another_file(self, files):
        affine, places = grid(AXES["oblique"])
        nrrd(files / "brain.nrrd", head(places, tumour=1), affine)
        sources = MaskSources(files / "brain.nrrd", brain=(1,), tumour_file=files / "tumour.nii.gz")
        subject = build_masked_subject(read_head_masks(sources))
        assert np.linalg.norm(subject.pieces[0].centre - 1e-3 * TUMOUR) < 5e-4
        assert subject.tumour_volume == pytest.approx(4 / 3 * np.pi * 0.012**3, rel=0.05)

    @pytest.mark.parametrize(
        ("moved", "reason"),
        [
            (np.array([200.0, 0.0, 0.0]), r"does not overlap the brain of .*brain\.nii\.gz, at -2\d, -1\d, -3\d to"),
            (None, "With x and y negated it would lie in the brain: one of the two states LPS as RAS"),
        ],
    )
    def test_disjoint_volumes_are_rejected_with_both_boxes(self, files, moved, reason):
        image = nibabel.load(files / "tumour.nii.gz")
        affine = LPS @ image.affine if moved is None else image.affine.copy()
        affine[:3, 3] += 0.0 if moved is None else moved
        nifti(files / "elsewhere.nii", np.asarray(image.dataobj), affine)
        with pytest.raises(InputError, match=reason) as caught:
            read_head_masks(MaskSources(files / "elsewhere.nii", tumour=(1,), mask=files / "brain.nii.gz"))
        assert str(caught.value).count("(RAS)") == 2

    def test_grid_with_x_and_y_negated_is_rejected(self, tmp_path):
        affine, places = grid(middle=np.zeros(3))
        brain = nifti(tmp_path / "brain.nii", (head(places + MIDDLE) > 0).astype(np.uint8), affine)
        tumour = nifti(tmp_path / "tumour.nii", (head(places + MIDDLE) == 3).astype(np.uint8), LPS @ affine)
        with pytest.raises(InputError, match=r"has the grid of .*, but with x and y negated"):
            read_head_masks(MaskSources(tumour, tumour=(1,), mask=brain))

    def test_tumour_outside_the_mask_is_noted(self, tmp_path):
        affine, places = grid()
        brain = nifti(tmp_path / "brain.nii", (head(places, tumour=0) > 0).astype(np.uint8), affine)
        tumour = nifti(tmp_path / "tumour.nii", (head(places) == 3).astype(np.uint8), affine)
        (note,) = read_head_masks(MaskSources(tumour, tumour=(1,), mask=brain)).notes
        assert re.fullmatch(r"7(\.\d)? ml of what is labelled lie outside of the mask: see that .*", note)

    def test_missing_or_contradicting_sources_are_rejected(self, files):
        tumour, brain = files / "tumour.nii.gz", files / "brain.nii.gz"
        nifti(files / "none.nii", np.zeros((5, 5, 5), np.uint8), np.eye(4))
        for sources, reason in (
            (MaskSources(tumour, brain=(1,), mask=brain), "give only one of them"),
            (MaskSources(tumour, mask=brain, tumour_file=tumour), "nothing is left"),
            (MaskSources(tumour, tumour=(1,), mask=files / "none.nii"), "none.nii: is empty"),
            (MaskSources(tumour, tumour=(1,)), "at least one label of the brain"),
            (MaskSources(tumour, brain=(1,)), "at least one label of the tumour"),
        ):
            with pytest.raises(InputError, match=reason):
                read_head_masks(sources)


def test_oedema_and_ventricles_become_regions(tmp_path):
    """Own labels, and names of a convention; with the volumes of their labels."""
    affine, places = grid()
    labels = head(places)
    rim = np.linalg.norm(places - TUMOUR, axis=-1)
    labels[(rim > 12.0) & (rim < 24.0) & (labels == 1)] = 5
    labels[np.linalg.norm(places - MIDDLE + [18.0, 0.0, 0.0], axis=-1) < 10.0] = 4
    path = nifti(tmp_path / "a.nii", labels, affine)
    sources = MaskSources(path, (1,), (3,), parts={"oedema": (5,), "ventricles": (4,)})
    masks = read_head_masks(sources)
    assert masks.brain.sum() == np.isin(labels, (1, 4, 5)).sum() and not build_masked_subject(masks).parts
    subject = build_masked_subject(masks, regions=("oedema", "ventricles"))
    mesh = make_anatomy(subject, MeshPlan(nodes=2500)).mesh
    for region, label, off in ((2, 3, 0.1), (3, 5, 0.02), (4, 4, 0.05)):
        marked = (labels == label).sum() * (1e-3 * EDGE) ** 3
        assert mesh.volumes[mesh.region == region].sum() == pytest.approx(marked, rel=off)
    assert set(np.unique(mesh.region)) == {1, 2, 3, 4}
    everywhere = make_anatomy(replace(subject, parts=(SubjectPart(3, subject.brain, 1.0),)), MeshPlan(nodes=2500)).mesh
    assert ((everywhere.region == 2) == (mesh.region == 2)).all()  # a tumour stays one
    with pytest.raises(
        InputError, match=r"marks no necrosis.*\. Choose from oedema, ventricles, or name .* by --necrosis"
    ):
        build_masked_subject(masks, regions=("necrosis",))
    with pytest.raises(InputError, match="label 3 is named by --tumour and by --oedema"):
        read_head_masks(MaskSources(path, (1,), (3,), parts={"oedema": (3,)}))
