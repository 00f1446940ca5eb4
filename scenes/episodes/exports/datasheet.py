"""The data sheet of a data set, by the questions of Gebru et al. (2021), "Datasheets for Datasets", CACM 64(12)."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ...script.shipped_files import get_template_path
from ..reading.bodies import is_template
from ..reading.contents import EpisodeContents
from ..reading.schema import ARRAYS, PICTURES
from ..run_folder import RUN, RunSettings

MOST_DRAWN = 100  # Maximum length of each list of sampled values.


def read_parameters(contents: EpisodeContents) -> dict[str, Any]:
    """Return the sampled parameters of an episode by dotted names; empty if not recorded as JSON.

    Tumours are sampled for synthetic anatomies only; those of others have no effect and are excluded.
    """
    try:
        found = dict(list_leaves(json.loads(contents.said.get("parameters", "{}"))))
    except (TypeError, ValueError, RecursionError):
        return {}
    placed = found.get("bodies.anatomies", "drawn") == "drawn"
    return {key: value for key, value in found.items() if placed or not key.startswith("bodies.tumour.")}


def format_variation_tables(episodes: Sequence[EpisodeContents]) -> Iterator[str]:
    """Lines of two tables: ranges of numbers and how often each text came; what is the same wherever it is."""
    values: dict[str, list[Any]] = {}
    for one in episodes:
        for key, value in read_parameters(one).items():
            values.setdefault(key, []).append(value)
    varied = {key: found for key, found in values.items() if any(one != found[0] for one in found)}
    same = {key: found for key, found in values.items() if key not in varied}
    if not values:
        yield "\nNothing was drawn at random, or the files do not say what."
    if varied:
        yield "\nWhat was drawn at random, from least to greatest:\n"
        yield "| what | from | to | episodes |\n|---|---|---|---|"
        yield from [format_range_row(key, found) for key, found in varied.items()][:MOST_DRAWN]
    if same:
        yield "\nWhat is the same in all episodes that have it:\n"
        yield "| what | value | episodes |\n|---|---|---|"
        yield from [f"| `{key}` | {format_cell(found[0])} | {len(found)} |" for key, found in same.items()][:MOST_DRAWN]


def format_range_row(key: str, found: Sequence[Any]) -> str:
    """Return a row of what varies."""
    if all(is_number(one) for one in found):
        return f"| `{key}` | {format_cell(min(found))} | {format_cell(max(found))} | {len(found)} |"
    often = ", ".join(f"{text} ({count})" for text, count in Counter(map(str, found)).most_common(8))
    return f"| `{key}` | {often} | | {len(found)} |"


def is_number(value: Any) -> bool:
    """Return True if a value is a number; booleans are not."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def format_cell(value: Any) -> str:
    """Return a value in a table: whole numbers in full, others to four digits."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def list_leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Numbers and texts of nested JSON by their dotted names; lists are numbered."""
    match value:
        case dict():
            for key, inner in value.items():
                yield from list_leaves(inner, f"{name}.{key}".strip("."))
        case list():
            for place, inner in enumerate(value):
                yield from list_leaves(inner, f"{name}.{place}".strip("."))
        case _:
            yield name, value


TEMPLATE, DRAWN, UNSTATED = "template", "drawn", ""
"""Origin of an anatomy: the shipped one, the same brain with another tumour, or unknown.

Else the name of an own one.
"""


def find_origin(contents: EpisodeContents) -> str:
    """Return the origin of an episode's anatomy: `TEMPLATE`, `DRAWN`, the name of an own one, or `UNSTATED`."""
    stated = read_parameters(contents).get("bodies.anatomies")
    if stated is not None:
        return str(stated)
    return TEMPLATE if is_template(str(contents.said.get("anatomy"))) else UNSTATED


def get_template_notice() -> str:
    """Return the notice that the template's authors require in all copies, as Markdown."""
    lines = get_template_path().with_suffix(".notice.txt").read_text(encoding="utf-8").splitlines()
    head = "The template's brain, also in `bodies`, is made from the ICBM 152 template of 2009 (MNI152). Its notice:"
    return "\n".join(["", head, "", *(f"> {line}" for line in lines), ""])


def has_template(episodes: Sequence[EpisodeContents]) -> bool:
    """Return True if any episode uses the template's brain."""
    return any(find_origin(one) in (TEMPLATE, DRAWN) for one in episodes)


def format_origins(episodes: Sequence[EpisodeContents]) -> Iterator[str]:
    """Lines of the data sheet."""
    for origin, count in Counter(find_origin(one) for one in episodes).most_common():
        if origin in (TEMPLATE, DRAWN):
            tumour = "one and the same" if origin == TEMPLATE else "drawn"
            yield (
                f"- In {count} episodes the brain is the ICBM 152 template's of 2009 (MNI152), as nilearn "
                "ships it, scaled to a person's. It is an average of 152 healthy adults, and nobody's own. "
                f"Tumour and opening were put into it; they are {tumour}."
            )
        elif origin == UNSTATED:
            yield f"- In {count} episodes the files do not say whose brain it is: write it here."
        else:
            yield f"- In {count} episodes the anatomy is the maker's own, `{origin}`. Write here whose it is."


MARK = "<!-- sulcus card 1 -->"  # Line that marks a generated data sheet.
NAME = "with sulcus"  # Text by which a data sheet names its program.
MOST_LISTED = 12  # Maximum number of effects, solvers and tools that are listed.


def write_datasheet(
    name: str,
    episodes: Sequence[EpisodeContents],
    rows: Sequence[Mapping[str, Any]],
    notes: Sequence[str] = (),
    run: RunSettings | None = None,
) -> str:
    """Return the sheet as Markdown, of what the files say: `rows` are those of the table of episodes.

    `notes` are sentences on what is missing or weak; `run` is the run whose folder it is.
    """
    parts = (
        f"# Data sheet: {name}\n\n{MARK}\n",
        "Made by sulcus from the files themselves. The questions are those of Gebru et al. (2021), *Datasheets for "
        "Datasets*.\n",
        describe_motivation(),
        describe_composition(episodes, rows, notes),
        describe_collection(episodes, run),
        UNKNOWN,
        "## Preprocessing\n\nColour is JPEG, depth PNG of 16 bits and labels PNG of 8 bits. Nothing else was changed. "
        "`sulcus validate` compares pictures, arrays and checksums.\n",
        "## Uses\n\nTo train and test methods that follow tools, estimate deformation or plan motion, before real data "
        "are used. Not for decisions about patients: nothing here was measured on one.\n",
        "## Distribution\n\nUnder CC BY 4.0, as `LICENSE.md` says in plain words.\n",
        "## Maintenance\n\nWhoever gives these data out answers for them: write here who, and where errors are "
        "reported. The plan below and the seeds above make them anew.\n",
        *format_plans(episodes),
    )
    return "\n".join(parts)


def describe_motivation() -> str:
    """Describe the motivation."""
    return (
        "## Motivation\n\nA tool that presses moves the brain, and the tumour in it. Where the tumour is at each "
        "moment is not known of real surgery. Here it is, because the surgery is simulated.\n"
    )


def describe_composition(
    episodes: Sequence[EpisodeContents], rows: Sequence[Mapping[str, Any]], notes: Sequence[str]
) -> str:
    """Describe the composition: counts, sizes, arrays."""
    lines = ["## Composition\n", "| family | episodes | frames | solved | seconds | GB |", "|---|---|---|---|---|---|"]
    for family in [*sorted({row["family"] for row in rows}), None]:
        those = [row for row in rows if family in (None, row["family"])]
        frames, solved, seconds, size = (
            sum(row[key] for row in those) for key in ("frames", "solved", "seconds", "bytes")
        )
        lines.append(f"| {family or 'all'} | {len(those)} | {frames} | {solved} | {seconds:.1f} | {size / 1e9:.3f} |")
    lines.append(f"\n*Solved* are frames that finite elements answered. {describe_bodies(episodes)}")
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


def describe_bodies(episodes: Sequence[EpisodeContents]) -> str:
    """Describe the numbers of anatomies and image sizes."""
    bodies = len({one.said.get("anatomy") for one in episodes})
    sizes = sorted({one.size for one in episodes})
    said_sizes = ", ".join(f"{width} x {height}" for width, height in sizes)
    return "\n".join([f"Anatomies: {bodies}. Pictures: {said_sizes} pixels.\n", *format_origins(episodes)])


def describe_collection(episodes: Sequence[EpisodeContents], run: RunSettings | None) -> str:
    """Describe the collection process, and the random variation."""
    lines = ["## Collection\n", "A scripted tool moved on a simulated brain, and a camera drew what it would see.\n"]
    tools = [str(tool).partition("(")[0] for tool in format_value(episodes, "tool")]  # sizes are among what was drawn
    lines += [*format_counts("what moved the tissue", format_value(episodes, "answered_by"))]
    lines += [
        *format_counts("what solved it", format_value(episodes, "finite_elements")),
        *format_counts("tool", tools),
    ]
    versions = sorted(set(map(str, format_value(episodes, "sulcus_version"))))
    dates = sorted(str(date)[:10] for date in format_value(episodes, "date"))
    if versions:
        lines.append(f"- sulcus {', '.join(versions)}" + (f", {dates[0]} to {dates[-1]}" if dates else ""))
    lines += [
        *format_counts("plan", format_value(episodes, "plan_name")),
        *format_counts("seed", format_value(episodes, "seed")),
    ]
    if run is not None:
        parts = ", ".join(f"{part} {version}" for part, version in run.versions.items())
        lines.append(f"- device: {run.device}; packages: {parts} (as `{RUN}` says)")
    lines += format_variation_tables(episodes)
    return "\n".join(lines) + "\n"


def format_counts(title: str, texts: Sequence[Any]) -> Iterator[str]:
    """Lines of how often there is what; of many different ones, those that are there most often."""
    often = Counter(map(str, texts)).most_common()
    yield from (f"- {title}: {text} (in {count})" for text, count in often[:MOST_LISTED])
    if often[MOST_LISTED:]:
        others = sum(count for _, count in often[MOST_LISTED:])
        yield f"- {title}: {len(often) - MOST_LISTED} others (in {others})"


def format_value(episodes: Sequence[EpisodeContents], key: str) -> list[Any]:
    """Return an attribute of all episodes that have it."""
    return [one.said[key] for one in episodes if key in one.said]


def format_plans(episodes: Sequence[EpisodeContents]) -> Iterator[str]:
    """Yield the plans, as they stand in the files."""
    for text in dict.fromkeys(map(str, format_value(episodes, "plan"))):
        yield f"## Plan\n\n```toml\n{text.strip()}\n```\n"


# Section on limitations.
UNKNOWN = """## What is not known

- How near the simulated motion is to a patient's. Finite elements and models agree with each other, not with a patient.
- The tissue of the person whose brain it is: stiffness, and how the skull and the fluid hold it, are assumed.
- What light, blood, smoke, instruments of other makes and hands do to pictures: none of it is drawn.
- Forces of real tools: they follow from the assumed tissue.
- Whether what a method learns here carries over to real pictures. That needs real ones.
"""
