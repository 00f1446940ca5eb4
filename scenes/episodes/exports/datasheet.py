"""The data sheet of a data set, by the questions of Gebru et al. (2021), "Datasheets for Datasets", CACM 64(12)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ..reading.contents import Contents
from ..reading.schema import ARRAYS, PICTURES
from ..run_folder import RUN, Run
from .provenance import drawn_tables, origins

MARK = "<!-- sulcus card 1 -->"
NAME = "with sulcus"
# Most of what moved, solved or touched tissue that is named.
MOST_LISTED = 12


def datasheet(
    name: str,
    episodes: Sequence[Contents],
    rows: Sequence[Mapping[str, Any]],
    notes: Sequence[str] = (),
    run: Run | None = None,
) -> str:
    """The sheet as Markdown, of what the files say: `rows` are those of the table of episodes.

    `notes` are sentences on what is missing or weak; `run` is the run whose folder it is.
    """
    parts = (
        f"# Data sheet: {name}\n\n{MARK}\n",
        "Made by sulcus from the files themselves. The questions are those of Gebru et al. (2021), *Datasheets for "
        "Datasets*.\n",
        motivation(),
        composition(episodes, rows, notes),
        collection(episodes, run),
        UNKNOWN,
        "## Preprocessing\n\nColour is JPEG, depth PNG of 16 bits and labels PNG of 8 bits. Nothing else was changed. "
        "`sulcus validate` compares pictures, arrays and checksums.\n",
        "## Uses\n\nTo train and test methods that follow tools, estimate deformation or plan motion, before real data "
        "are used. Not for decisions about patients: nothing here was measured on one.\n",
        "## Distribution\n\nUnder CC BY 4.0, as `LICENSE.md` says in plain words.\n",
        "## Maintenance\n\nWhoever gives these data out answers for them: write here who, and where errors are "
        "reported. The plan below and the seeds above make them anew.\n",
        *plans(episodes),
    )
    return "\n".join(parts)


def motivation() -> str:
    """Why it was made."""
    return (
        "## Motivation\n\nA tool that presses moves the brain, and the tumour in it. Where the tumour is at each "
        "moment is not known of real surgery. Here it is, because the surgery is simulated.\n"
    )


def composition(episodes: Sequence[Contents], rows: Sequence[Mapping[str, Any]], notes: Sequence[str]) -> str:
    """What it consists of: counts, sizes, arrays."""
    lines = ["## Composition\n", "| family | episodes | frames | solved | seconds | GB |", "|---|---|---|---|---|---|"]
    for family in [*sorted({row["family"] for row in rows}), None]:
        those = [row for row in rows if family in (None, row["family"])]
        frames, solved, seconds, size = (
            sum(row[key] for row in those) for key in ("frames", "solved", "seconds", "bytes")
        )
        lines.append(f"| {family or 'all'} | {len(those)} | {frames} | {solved} | {seconds:.1f} | {size / 1e9:.3f} |")
    lines.append(f"\n*Solved* are frames that finite elements answered. {bodies_said(episodes)}")
    lines += [*notes, ""]
    lines += ["| array | unit | in episodes |", "|---|---|---|"]
    counts = Counter(name for one in episodes for name in one.shapes)
    for key, count in sorted(counts.items()):
        unit = "picture" if key in PICTURES else ARRAYS[key].unit or ""
        lines.append(f"| `{key}` | {unit} | {count} |")
    worst = [row["largest_error_mm"] for row in rows if row["largest_error_mm"] != ""]
    if worst:
        lines.append(
            f"\nThe largest distance of a predicted tumour vertex from the finite elements' is {max(worst):#.3g} mm, "
            "in the frames that they solved. That is an error of the model, not of the tumour in a patient."
        )
    played = sum(row["deformer"] == "fem" for row in rows)
    if played:
        lines.append(f"\nFinite elements played {played} of the episodes: no model predicted anything there.")
    lines.append("Attributes of each array say what it means, and the file formats of sulcus describe them.\n")
    return "\n".join(lines)


def bodies_said(episodes: Sequence[Contents]) -> str:
    """How many anatomies and pictures' sizes there are."""
    bodies = len({one.said.get("anatomy") for one in episodes})
    sizes = sorted({one.size for one in episodes})
    said_sizes = ", ".join(f"{width} x {height}" for width, height in sizes)
    return "\n".join([f"Anatomies: {bodies}. Pictures: {said_sizes} pixels.\n", *origins(episodes)])


def collection(episodes: Sequence[Contents], run: Run | None) -> str:
    """How it came about, and what was drawn at random."""
    lines = ["## Collection\n", "A scripted tool moved on a simulated brain, and a camera drew what it would see.\n"]
    tools = [str(tool).partition("(")[0] for tool in said(episodes, "tool")]  # sizes are among what was drawn
    lines += [*listed("what moved the tissue", said(episodes, "answered_by"))]
    lines += [*listed("what solved it", said(episodes, "finite_elements")), *listed("tool", tools)]
    versions = sorted(set(map(str, said(episodes, "sulcus_version"))))
    dates = sorted(str(date)[:10] for date in said(episodes, "date"))
    if versions:
        lines.append(f"- sulcus {', '.join(versions)}" + (f", {dates[0]} to {dates[-1]}" if dates else ""))
    lines += [*listed("plan", said(episodes, "plan_name")), *listed("seed", said(episodes, "seed"))]
    if run is not None:
        parts = ", ".join(f"{part} {version}" for part, version in run.versions.items())
        lines.append(f"- device: {run.device}; packages: {parts} (as `{RUN}` says)")
    lines += drawn_tables(episodes)
    return "\n".join(lines) + "\n"


def listed(title: str, texts: Sequence[Any]) -> Iterator[str]:
    """Lines of how often there is what; of many different ones, those that are there most often."""
    often = Counter(map(str, texts)).most_common()
    yield from (f"- {title}: {text} (in {count})" for text, count in often[:MOST_LISTED])
    if often[MOST_LISTED:]:
        others = sum(count for _, count in often[MOST_LISTED:])
        yield f"- {title}: {len(often) - MOST_LISTED} others (in {others})"


def said(episodes: Sequence[Contents], key: str) -> list[Any]:
    """An attribute of all episodes that have it."""
    return [one.said[key] for one in episodes if key in one.said]


def plans(episodes: Sequence[Contents]) -> Iterator[str]:
    """The plans, as they stand in the files."""
    for text in dict.fromkeys(map(str, said(episodes, "plan"))):
        yield f"## Plan\n\n```toml\n{text.strip()}\n```\n"


UNKNOWN = """## What is not known

- How near the simulated motion is to a patient's. Finite elements and models agree with each other, not with a patient.
- The tissue of the person whose brain it is: stiffness, and how the skull and the fluid hold it, are assumed.
- What light, blood, smoke, instruments of other makes and hands do to pictures: none of it is drawn.
- Forces of real tools: they follow from the assumed tissue.
- Whether what a method learns here carries over to real pictures. That needs real ones.
"""
