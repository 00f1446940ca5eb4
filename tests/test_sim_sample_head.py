"""Synthetic patient: orientation, units, volumes and intensities as another program reads them."""

import gzip
from dataclasses import replace

import nibabel
import numpy as np
import pytest

from scenes.script.shipped_files import get_template_path
from sim.bodies.intensity import encode_intensity
from sim.bodies.meshfile import read_anatomy
from sim.bodies.sample_head import SAMPLE_TUMOUR, SampleHead, build_sample_head
from sim.errors import InputError


@pytest.fixture(scope="module")
def template():
    return read_anatomy(get_template_path())


@pytest.fixture(scope="module")
def images(template):
    """Label map and T1, from the bytes of their files."""
    return [
        nibabel.Nifti1Image.from_bytes(gzip.decompress(encode_intensity(volume)))
        for volume in build_sample_head(template.mesh)
    ]


def test_sample_is_oblique_and_in_millimetres(images):
    labels, t1 = images
    assert labels.shape == t1.shape and np.array_equal(labels.affine, t1.affine)
    for image in images:
        assert image.header.get_xyzt_units()[0] == "mm" and image.get_data_dtype() == np.uint8
        assert image.get_sform(coded=True)[1] > 0
    assert nibabel.aff2axcodes(labels.affine) == ("L", "P", "S")
    axes = labels.affine[:3, :3] / nibabel.affines.voxel_sizes(labels.affine)
    assert nibabel.affines.voxel_sizes(labels.affine) == pytest.approx([1.6, 1.6, 1.8], rel=1e-6)
    assert axes.T @ axes == pytest.approx(np.eye(3), abs=1e-6) and np.linalg.det(axes) == pytest.approx(1.0)
    assert nibabel.affines.obliquity(labels.affine).max() > 0.1


def test_sample_brain_is_the_stretched_template(template, images):
    labels = images[0]
    stretch = np.array(SampleHead().stretch)
    places = nibabel.affines.apply_affine(labels.affine, np.argwhere(np.asarray(labels.dataobj) > 0))
    nodes = 1e3 * template.mesh.nodes * stretch
    assert places.min(axis=0) == pytest.approx(nodes.min(axis=0), abs=1.8)
    assert places.max(axis=0) == pytest.approx(nodes.max(axis=0), abs=1.8)
    volume = len(places) * abs(np.linalg.det(labels.affine[:3, :3]))
    assert volume == pytest.approx(1e9 * template.mesh.volumes.sum() * stretch.prod(), rel=0.003)


def test_sample_tumour_is_lobed_and_in_another_place(template, images):
    labels = images[0]
    places = nibabel.affines.apply_affine(labels.affine, np.argwhere(np.asarray(labels.dataobj) == 2))
    volume = len(places) * abs(np.linalg.det(labels.affine[:3, :3]))
    assert volume == pytest.approx(4.0 / 3.0 * np.pi * 12.0**3, rel=0.02)
    assert np.linalg.norm(places.mean(axis=0) - 1e3 * np.array(SAMPLE_TUMOUR.middle)) < 3.0
    assert places.mean(axis=0)[0] < -20.0  # left
    own = 1e3 * template.mesh.nodes[template.tumour_nodes].mean(axis=0)
    assert np.linalg.norm(places.mean(axis=0) * [-1.0, 1.0, 1.0] - own) > 30.0  # also of the mirrored brain
    arms = np.linalg.norm(places - places.mean(axis=0), axis=1)
    assert arms.max() > 1.3 * 12.0  # a ball has 12 mm


def test_sample_t1_shows_tissue_and_fluid(images):
    labels, grey = (np.asarray(image.dataobj) for image in images)
    head = SampleHead()
    assert np.median(grey[labels == 2]) == pytest.approx(head.tumour_grey, abs=1.0)
    assert np.percentile(grey[labels == 1], [1, 90]) == pytest.approx([head.greys[0], head.greys[-1]], abs=12.0)
    assert np.median(grey[labels == 0]) == 0.0


def test_sample_has_the_same_bytes_each_time(template):
    first, second = ([encode_intensity(one) for one in build_sample_head(template.mesh)] for _ in range(2))
    assert first == second and all(data[4:8] == bytes(4) for data in first)  # no time of the run
    labels, t1 = map(encode_intensity, build_sample_head(template.mesh, SampleHead(seed=2)))
    assert labels == first[0] and t1 != first[1]


def test_sample_rejects_a_tumour_outside_the_brain(template):
    outside = replace(SAMPLE_TUMOUR, middle=(0.0, 0.0, 0.2))
    with pytest.raises(InputError, match="out of the brain"):
        build_sample_head(template.mesh, SampleHead(tumour=outside))
