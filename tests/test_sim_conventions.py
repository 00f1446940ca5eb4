"""Labels of widely used programs: recognised by their numbers, and compared with the anatomy."""

import re
from contextlib import nullcontext

import numpy as np
import pytest
from test_sim_head_masks import AXES, EDGE, MIDDLE, TUMOUR, grid, head, mgz, nifti

from sim.bodies.head_masks import MaskSources, read_head_masks
from sim.bodies.label_map import read_labels
from sim.bodies.label_volume import build_masked_subject
from sim.errors import InputError

PIECES = (np.zeros(3), 20.0), (np.array([-45.0, -10.0, -5.0]), 12.0)  # shifts and radii [mm] of a tumour's
ROLES = {"brats": (1, 2, 3), "brats 2021": (1, 2, 4), "nnunet": (2, 1, 3), "brats-ped": (2, 4, 1)}
"""Labels of necrosis, oedema and enhancing tumour in files of a convention."""


class TestConventions:
    def brats(self, folder, enhancing):
        affine, places = grid()
        labels = np.where(np.linalg.norm(places - TUMOUR, axis=-1) < 18.0, 2, 0)
        core = np.linalg.norm(places - TUMOUR, axis=-1)
        labels[core < 12.0], labels[core < 6.0] = enhancing, 1
        nifti(folder / "t1.nii", (head(places) > 0).astype(np.float32), affine)
        return nifti(folder / "seg.nii", labels.astype(np.uint8), affine)

    @pytest.mark.parametrize("enhancing", [3, 4])
    def test_brats_labels_give_tumour_necrosis_and_oedema(self, tmp_path, enhancing):
        path = self.brats(tmp_path, enhancing)
        masks = read_head_masks(MaskSources(path, convention="brats", mask=tmp_path / "t1.nii"))
        assert build_masked_subject(masks).tumour_volume == pytest.approx(4 / 3 * np.pi * 0.012**3, rel=0.05)
        assert {name: int(mask.sum()) for name, mask in masks.parts.items()} == {
            "necrosis": (read_labels(path).layers == 1).sum(), "oedema": (read_labels(path).layers == 2).sum()
        }  # fmt: skip
        with pytest.raises(InputError, match="labels of brats do not mark the brain"):
            read_head_masks(MaskSources(path, convention="brats"))

    def test_cavity_label_is_not_part_of_tumour(self, tmp_path):
        affine, places = grid()
        labels = head(places, brain=0)
        labels[10:14, 10:14, 10:14] = 4
        nifti(tmp_path / "seg.nii", labels, affine)
        nifti(tmp_path / "t1.nii", head(places), affine)
        with pytest.raises(InputError, match=r"it has 3 and 4 together\. It looks like brats2015 or brats-post or"):
            read_head_masks(MaskSources(tmp_path / "seg.nii", convention="brats", mask=tmp_path / "t1.nii"))
        masks = read_head_masks(
            MaskSources(tmp_path / "seg.nii", tumour=(3,), convention="brats", mask=tmp_path / "t1.nii")
        )
        assert masks.tumour.sum() == (labels == 3).sum()
        for parts, noted in (({}, True), ({"ventricles": (4,)}, False)):
            post = MaskSources(tmp_path / "seg.nii", convention="brats-post", mask=tmp_path / "t1.nii", parts=parts)
            notes = " ".join(read_head_masks(post).notes)
            assert ("1.7 ml are a cavity, label 4: " in notes and "--ventricles 4" in notes) == noted

    def tumour(self, folder, roles, missing=(), open_rim=False, depth=30.0):
        """A tumour in two pieces, cut by the cortex `depth` [mm] above it; a third of its rim may be open."""
        affine, places = grid()
        far = np.minimum(*(np.linalg.norm(places - TUMOUR - shift, axis=-1) / size for shift, size in PIECES))
        labels = np.select([far < 0.5, far < 0.75, far < 1.0], [roles[0], roles[2], roles[1]], 0)
        if open_rim:
            labels[(labels == roles[2]) & (places[..., 0] > TUMOUR[0] + 6.0)] = roles[1]
        for one in missing:
            labels[labels == roles[one]] = (roles[2], 0)[one]
        labels[places[..., 2] > TUMOUR[2] + depth] = 0
        nifti(folder / "t1.nii", (head(places) > 0).astype(np.float32), affine)
        return nifti(folder / "seg.nii", labels.astype(np.uint8), affine)

    @pytest.mark.parametrize("given", [{}, {"missing": (0,)}, {"missing": (1,)}, {"open_rim": True}, {"depth": 3.0}])
    @pytest.mark.parametrize("real", ROLES)
    def test_convention_that_anatomy_contradicts_is_rejected(self, tmp_path, real, given):
        roles = ROLES[real]
        path = self.tumour(tmp_path, roles, **given)
        name = real.split()[0]
        masks = read_head_masks(MaskSources(path, convention=name, mask=tmp_path / "t1.nii"))
        assert masks.tumour.sum() == np.isin(read_labels(path).layers, [roles[0], roles[2]]).sum() > 0
        wrong = "brats" if name == "nnunet" else "nnunet"
        if name != "brats-ped":
            with pytest.raises(InputError, match=rf"is not labelled as {wrong} .* It looks like .*\b{name}\b"):
                read_head_masks(MaskSources(path, convention=wrong, mask=tmp_path / "t1.nii"))
        if not given:  # numbers of one's own go before, with a note
            parts = {"oedema": (roles[0],)}
            own = MaskSources(path, (), (roles[1], roles[2]), wrong, tmp_path / "t1.nii", parts=parts)
            assert "would be oedema and lies inside the tumour" in " ".join(read_head_masks(own).notes)
            whole = read_head_masks(MaskSources(tmp_path / "t1.nii", brain=(1,), tumour_file=path))
            assert "are all taken for tumour: name those of the core by --tumour" in " ".join(whole.notes)

    @pytest.mark.parametrize(("order", "fits"), [((1, 2, 3), True), ((3, 1, 2), False), ((3, 2, 1), False)])
    def test_fsl_labels_in_another_order_are_rejected(self, tmp_path, order, fits):
        """Fluid, grey and white matter of FAST on a T1; of SPM; of FAST on a T2."""
        affine, places = grid()
        size = np.linalg.norm((places - MIDDLE) / [46.0, 55.0, 42.0], axis=-1)
        labels = np.select([size < 0.7, size < 0.9, size < 1.0], [order[2], order[1], order[0]], 0)
        labels[np.linalg.norm(places - TUMOUR, axis=-1) < 12.0] = 9
        sources = MaskSources(nifti(tmp_path / "a.nii", labels.astype(np.int16), affine), tumour=(9,), convention="fsl")
        with nullcontext() if fits else pytest.raises(InputError, match="label 3 lies outside of the others, "):
            read_head_masks(sources)

    def aseg(self, folder, name="aseg.mgz", mirrored=False):
        """White matter and cortex by halves, a ventricle on the left, and fluid around."""
        affine, places = grid(AXES["oblique"])
        whole = head(places, tumour=1)
        size = np.linalg.norm((places - MIDDLE) / [46.0, 55.0, 42.0], axis=-1)
        right = (places[..., 0] > MIDDLE[0]) ^ mirrored
        labels = np.where(whole == 0, np.where(size < 1.1, 24, 0), np.where(size > 0.8, 3, 2))
        labels[right & (whole > 0)] += 39
        labels[np.linalg.norm(places - MIDDLE + [15.0, 0.0, 0.0], axis=-1) < 8.0] = 4
        small, near = grid(edge=2.0, count=16, middle=TUMOUR)
        nifti(folder / "tumour.nii", (head(near) == 3).astype(np.int16), small)
        return mgz(folder / name, labels.astype(np.int32), affine)

    @pytest.mark.parametrize("name", ["freesurfer", "synthseg"])
    def test_freesurfer_labels_give_brain_and_ventricles(self, tmp_path, name):
        path = self.aseg(tmp_path)
        masks = read_head_masks(MaskSources(path, convention=name, tumour_file=tmp_path / "tumour.nii"))
        subject = build_masked_subject(masks)
        assert masks.parts["ventricles"].any() and subject.notes == ()
        low, high = 1e3 * subject.cortex.min(axis=0), 1e3 * subject.cortex.max(axis=0)
        np.testing.assert_allclose([low, high], MIDDLE + np.outer([-1, 1], [46.0, 55.0, 42.0]), atol=EDGE)

    def test_mirrored_freesurfer_labels_are_rejected(self, tmp_path):
        path = self.aseg(tmp_path, mirrored=True)
        with pytest.raises(InputError, match=r"left half lie \d+ mm to the right of .* Its affine is mirrored, or"):
            read_head_masks(MaskSources(path, convention="freesurfer", tumour_file=tmp_path / "tumour.nii"))

    def test_labels_of_another_program_are_rejected(self, tmp_path):
        aseg, brats, tumour = self.aseg(tmp_path), self.brats(tmp_path, 4), tmp_path / "tumour.nii"
        for sources, reason in (
            (
                MaskSources(aseg, convention="brats", mask=tmp_path / "t1.nii"),
                "it has 24, 41, 42 in addition. It looks like free",
            ),
            (
                MaskSources(aseg, convention="fsl", tumour_file=tumour),
                "it has 4, 24, 41, 42 in addition. It looks like freesurfer or",
            ),
            (MaskSources(brats, convention="freesurfer", tumour_file=tumour), "it lacks 41. It looks like brats"),
            (MaskSources(brats, convention="fsl", tumour_file=tumour), "it lacks 3. It looks like brats"),
        ):
            with pytest.raises(InputError, match=re.escape(reason)):
                read_head_masks(sources)

    def test_fsl_labels_accept_own_tumour_number(self, tmp_path):
        affine, places = grid()
        labels = head(places, brain=2, tumour=9)
        labels[(labels == 2) & (places[..., 2] > MIDDLE[2])] = 3
        path = nifti(tmp_path / "a.nii", labels, affine)
        masks = read_head_masks(MaskSources(path, tumour=(9,), convention="fsl"))
        assert masks.brain.sum() == np.isin(labels, (2, 3)).sum() and masks.tumour.sum() == (labels == 9).sum()
        with pytest.raises(InputError, match="no labels are called 'spm': choose one of brats, freesurfer"):
            read_head_masks(MaskSources(path, convention="spm"))
