"""Croissant metadata, read by mlcroissant."""

import os
import subprocess

import pytest

from scenes import write_card

FOREIGN = os.environ.get("SULCUS_FORMATS_PYTHON")
"""A Python that has lerobot, datasets and mlcroissant, whose own readers then read what is written here."""


@pytest.mark.skipif(FOREIGN is None, reason="needs SULCUS_FORMATS_PYTHON, a Python with mlcroissant")
def test_mlcroissant_reads_metadata_without_errors(folder):
    write_card(folder)
    read = (
        "import sys, mlcroissant; data = mlcroissant.Dataset(sys.argv[1])\n"
        "issues = data.metadata.issues; assert not issues.errors and not issues.warnings, issues.report()\n"
        "print([row['episodes/frames'] for row in data.records('episodes')])"
    )
    words = [str(FOREIGN), "-c", read, str(folder / "croissant.json")]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[7, 9]"
