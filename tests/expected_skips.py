"""Tests are skipped for the reasons listed here alone: any other skip fails, so that none is lost unnoticed."""

import re

import pytest

EXPECTED = (
    # Devices and programs.
    "no CUDA device|there is a card here|there is no Chromium here|needs make|libopenigtlink-dev",
    # Packages of extras, and Pythons of other projects, that variables name.
    r"not installed|no container engine runs|needs SULCUS_\w+|SULCUS_\w+ names no Python",
    # Systems, and what needs a machine or an account of its own.
    "could not import 'resource'|needs (processes|a device|a file system)|system's table",
    "no such file system|root writes anywhere|^there is$|small strain is not invariant",
)
REASON = re.compile("|".join(EXPECTED))


def as_failed(report):
    """The report of a test or a file; failed where it was skipped for a reason that is not listed."""
    if report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        if not REASON.search(reason.removeprefix("Skipped: ")):
            report.outcome, report.longrepr = "failed", f"{reason}: tests/expected_skips.py does not list this reason"
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport():
    """Look at each phase of a test."""
    return as_failed((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report():
    """Look at each file."""
    return as_failed((yield))
