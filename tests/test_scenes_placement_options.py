"""Options for the craniotomy and the tumour: selected piece, and kept data."""

from dataclasses import replace
from types import SimpleNamespace

import nibabel
import numpy as np
import pytest
from balls import ball

from scenes.cli import main
from scenes.options.placement_options import place_craniotomy
from sim.bodies.label_volume import build_volume_subject
from sim.errors import InputError
from sim.runtime.journal import open_journal


def two_foci(folder):
    """A head with a tumour of 10 mm radius on the right, and one of 6 mm on the left, in front."""
    ball(folder)
    image = nibabel.load(folder / "labels.nii.gz")
    labels = np.asarray(image.dataobj).copy()
    places = 2.0 * (np.moveaxis(np.indices((64, 64, 64)), 0, -1) - 31.5)
    labels[np.linalg.norm(places - [-25.0, 25.0, 20.0], axis=-1) < 6.0] = 2
    nibabel.save(nibabel.Nifti1Image(labels, image.affine), folder / "labels.nii.gz")


def test_craniotomy_lies_over_the_selected_tumour_piece(tmp_path):
    two_foci(tmp_path)
    subject = build_volume_subject(tmp_path / "labels.nii.gz", (1,), (2,))
    large, small = subject.pieces
    assert large.volume > 3.0 * small.volume and large.centre[0] > 0.0 > small.centre[0]
    asked = dict.fromkeys(("opening_at", "opening_over"))
    site = place_craniotomy(subject, SimpleNamespace(**asked)).site
    assert site[0] > 0.0 and site @ large.centre > 0.99 * np.linalg.norm(site) * np.linalg.norm(large.centre)
    site = place_craniotomy(subject, SimpleNamespace(**asked | {"opening_over": 2})).site
    assert site @ small.centre > 0.99 * np.linalg.norm(site) * np.linalg.norm(small.centre)
    at = place_craniotomy(subject, SimpleNamespace(**asked | {"opening_at": (-50.0, 0.0, 20.0)})).site
    assert np.linalg.norm(at - [-0.05, 0.0, 0.02]) < 5e-3
    site = place_craniotomy(subject, SimpleNamespace(**asked | {"opening_over": (-25.0, 25.0, 20.0)})).site
    assert site[0] < -0.02 and site[1] > 0.02
    with pytest.raises(InputError, match=r"lies \d+ mm outside the brain"):
        place_craniotomy(subject, SimpleNamespace(**asked | {"opening_over": (-90.0, 0.0, 20.0)}))
    with pytest.raises(InputError, match="has 2 pieces: choose 1 to 2"):
        place_craniotomy(subject, SimpleNamespace(**asked | {"opening_over": 3}))
    with pytest.raises(InputError, match="has one piece: give no number"):
        place_craniotomy(replace(subject, pieces=(large,)), SimpleNamespace(**asked | {"opening_over": 2}))


def test_anatomy_command_lists_tumour_pieces_and_keeps_data(tmp_path, capsys):
    two_foci(tmp_path)
    out = tmp_path / "me.vtu"
    words = ["anatomy", "--labels", str(tmp_path / "labels.nii.gz"), "--brain", "1", "--tumour", "2", "--nodes", "2000"]
    words += ["--opening-over", "-25,25,20", "--out", str(out)]
    assert main(words) == 0
    said, noted = capsys.readouterr()
    assert "holds 8.7 % less tumour than" in noted and "ask for more nodes" in noted
    assert "2 pieces; the skull is opened over the point given" in said and "piece 2: 0.88 ml, left anterior" in said
    assert "opening: left anterior superior" in said
    with open_journal(tmp_path / "me.h5.partial", {"anatomy": "of another"}):
        pass
    assert main(words) == 2 and "me.vtu: exists. Give --force" in capsys.readouterr().err
    out.rename(tmp_path / "other.vtu")
    assert main(words) == 2
    assert "me.h5.partial" in (error := capsys.readouterr().err) and "--force" in error and not out.exists()
