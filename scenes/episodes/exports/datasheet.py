"""Data sheet of a data set, by the questions of Gebru et al. (2021), "Datasheets for Datasets", CACM 64(12)."""

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ...script.shipped_files import get_template_path
from ..reading.bodies import is_template
from ..reading.contents import EpisodeContents
from ..reading.schema import ARRAYS, PICTURES
from ..run_folder import RUN, RunSettings

MAX_LISTED_VALUES = 100  # Maximum length of each list of sampled values.


def read_parameters(contents: EpisodeContents) -> dict[str, Any]:
    """Read the sampled parameters of an episode, by dotted name; empty if they are not recorded as JSON.

    Parameters of the tumour are excluded unless the anatomy is synthetic, because they have no effect otherwise.
    """
    try:
        found = dict(list_leaves(json.loads(contents.attributes.get("parameters", "{}"))))
    except (TypeError, ValueError, RecursionError):
        return {}
    placed = found.get("bodies.anatomies", "drawn") == "drawn"
    return {key: value for key, value in found.items() if placed or not key.startswith("bodies.tumour.")}


def format_variation_tables(episodes: Sequence[EpisodeContents]) -> Iterator[str]:
    """Yield the lines of two tables: varied parameters with ranges or frequent values, and constant parameters."""
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
        yield from [format_range_row(key, found) for key, found in varied.items()][:MAX_LISTED_VALUES]
    if same:
        yield "\nWhat is the same in all episodes that have it:\n"
        yield "| what | value | episodes |\n|---|---|---|"
        yield from [f"| `{key}` | {format_cell(found[0])} | {len(found)} |" for key, found in same.items()][
            :MAX_LISTED_VALUES
        ]


def format_range_row(key: str, values: Sequence[Any]) -> str:
    """Format the table row of a varied parameter: range of numbers, or frequencies of texts."""
    if all(is_number(one) for one in values):
        return f"| `{key}` | {format_cell(min(values))} | {format_cell(max(values))} | {len(values)} |"
    often = ", ".join(f"{text} ({count})" for text, count in Counter(map(str, values)).most_common(8))
    return f"| `{key}` | {often} | | {len(values)} |"


def is_number(value: Any) -> bool:
    """Return True if a value is a number; a boolean is not a number."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def format_cell(value: Any) -> str:
    """Format a value for a table cell; floating-point numbers have four significant digits."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def list_leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted names and values of numbers and texts in nested JSON; items of lists are numbered."""
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
"""Origins of an anatomy: shipped template, template with another tumour, or unknown.

Other values: the name of a custom anatomy.
"""


def find_origin(contents: EpisodeContents) -> str:
    """Return the origin of an episode's anatomy: `TEMPLATE`, `DRAWN`, name of a custom anatomy, or `UNSTATED`."""
    stated = read_parameters(contents).get("bodies.anatomies")
    if stated is not None:
        return str(stated)
    return TEMPLATE if is_template(str(contents.attributes.get("anatomy"))) else UNSTATED


def get_template_notice() -> str:
    """Return the notice that the template's authors require in all copies, as Markdown."""
    lines = get_template_path().with_suffix(".notice.txt").read_text(encoding="utf-8").splitlines()
    head = "The template's brain, also in `bodies`, is made from the ICBM 152 template of 2009 (MNI152). Its notice:"
    return "\n".join(["", head, "", *(f"> {line}" for line in lines), ""])


def has_template(episodes: Sequence[EpisodeContents]) -> bool:
    """Return True if any episode uses the template's brain."""
    return any(find_origin(one) in (TEMPLATE, DRAWN) for one in episodes)


def format_origins(episodes: Sequence[EpisodeContents]) -> Iterator[str]:
    """Yield lines that describe the sources of the episodes' anatomies."""
    for origin, count in Counter(find_origin(one) for one in episodes).most_common():
        if origin in (TEMPLATE, DRAWN):
            tumour = "the same in all" if origin == TEMPLATE else "sampled"
            yield (
                f"- In {count} episodes the brain is the ICBM 152 template's of 2009 (MNI152), as nilearn "
                "ships it, scaled to a person's. It is an average of 152 healthy adults, not of a single person. "
                f"Tumour and opening are synthetic; they are {tumour}."
            )
        elif origin == UNSTATED:
            yield f"- In {count} episodes the files do not give the source of the brain: write it here."
        else:
            yield f"- In {count} episodes the anatomy is a custom one, `{origin}`. Write its source here."


MARK = "<!-- sulcus card 1 -->"  # Line that marks a generated data sheet.
NAME = "with sulcus"  # Text by which a data sheet names its program.
MAX_LISTED_NAMES = 12  # Maximum number of effects, solvers and tools that are listed.


def write_datasheet(
    name: str,
    episodes: Sequence[EpisodeContents],
    rows: Sequence[Mapping[str, Any]],
    notes: Sequence[str] = (),
    run: RunSettings | None = None,
) -> str:
    """Build the data sheet as Markdown from the attributes of the files and the `rows` of the table of episodes.

    `notes` are sentences on missing or weak parts; `run` contains the settings of the folder's run.
    """
    parts = (
        f"# Data sheet: {name}\n\n{MARK}\n",
        "Made by sulcus from the files themselves. The questions are those of Gebru et al. (2021), *Datasheets for "
        "Datasets*.\n",
        describe_motivation(),
        describe_composition(episodes, rows, notes),
        describe_collection(episodes, run),
        LIMITATIONS,
        "## Preprocessing\n\nColour is JPEG, depth PNG of 16 bits and labels PNG of 8 bits. Nothing else was changed. "
        "`sulcus validate` compares images, arrays and checksums.\n",
        "## Uses\n\nTo train and test methods that track tools, estimate deformation or plan motion, before real data "
        "are used. Not for decisions about patients: nothing here was measured on one.\n",
        "## Distribution\n\nUnder CC BY 4.0, see the summary in `LICENSE.md`.\n",
        "## Maintenance\n\nThe publisher of these data is responsible for them: write the contact for error "
        "reports here. The plan below and the seeds above reproduce them.\n",
        *format_plans(episodes),
    )
    return "\n".join(parts)


def describe_motivation() -> str:
    """Return the section on the motivation of the data set."""
    return (
        "## Motivation\n\nA tool that presses moves the brain, and the tumour in it. Where the tumour is at each "
        "moment is not known of real surgery. Here it is, because the surgery is simulated.\n"
    )


def describe_composition(
    episodes: Sequence[EpisodeContents], rows: Sequence[Mapping[str, Any]], notes: Sequence[str]
) -> str:
    """Build the section on the composition of the data set: numbers, sizes and arrays."""
    lines = ["## Composition\n", "| family | episodes | frames | solved | seconds | GB |", "|---|---|---|---|---|---|"]
    for family in [*sorted({row["family"] for row in rows}), None]:
        those = [row for row in rows if family in (None, row["family"])]
        frames, solved, seconds, size = (
            sum(row[key] for row in those) for key in ("frames", "solved", "seconds", "bytes")
        )
        lines.append(f"| {family or 'all'} | {len(those)} | {frames} | {solved} | {seconds:.1f} | {size / 1e9:.3f} |")
    lines.append(f"\n*Solved*: frames that FEM solved. {describe_bodies(episodes)}")
    lines += [*notes, ""]
    lines += ["| array | unit | in episodes |", "|---|---|---|"]
    counts = Counter(name for one in episodes for name in one.shapes)
    for key, count in sorted(counts.items()):
        unit = "image" if key in PICTURES else ARRAYS[key].unit or ""
        lines.append(f"| `{key}` | {unit} | {count} |")
    worst = [row["largest_error_mm"] for row in rows if row["largest_error_mm"] != ""]
    if worst:
        lines.append(
            f"\nThe maximum tumour vertex error relative to FEM is {max(worst):#.3g} mm, "
            "in the solved frames. It is a model error, not the error of the tumour position in a patient."
        )
    played = sum(row["deformer"] == "fem" for row in rows)
    if played:
        lines.append(f"\nFEM was used directly in {played} of the episodes: they contain no model prediction.")
    lines.append("The attributes of each array describe it; see also the page on file formats of sulcus.\n")
    return "\n".join(lines)


def describe_bodies(episodes: Sequence[EpisodeContents]) -> str:
    """Describe the number and sources of anatomies, and the image sizes."""
    bodies = len({one.attributes.get("anatomy") for one in episodes})
    sizes = sorted({one.size for one in episodes})
    said_sizes = ", ".join(f"{width} x {height}" for width, height in sizes)
    return "\n".join([f"Anatomies: {bodies}. Images: {said_sizes} pixels.\n", *format_origins(episodes)])


def describe_collection(episodes: Sequence[EpisodeContents], run: RunSettings | None) -> str:
    """Build the section on the collection process: models, tools, versions and random variation."""
    lines = ["## Collection\n", "A scripted tool moved on a simulated brain, and a camera view was rendered.\n"]
    tools = [str(tool).partition("(")[0] for tool in format_value(episodes, "tool")]  # sizes are sampled parameters
    lines += [*format_counts("deformation model", format_value(episodes, "answered_by"))]
    lines += [*format_counts("FEM solver", format_value(episodes, "finite_elements")), *format_counts("tool", tools)]
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
    """Yield lines with the frequencies of the texts, for the `MAX_LISTED_NAMES` most frequent texts and the others."""
    often = Counter(map(str, texts)).most_common()
    yield from (f"- {title}: {text} (in {count})" for text, count in often[:MAX_LISTED_NAMES])
    if often[MAX_LISTED_NAMES:]:
        others = sum(count for _, count in often[MAX_LISTED_NAMES:])
        yield f"- {title}: {len(often) - MAX_LISTED_NAMES} others (in {others})"


def format_value(episodes: Sequence[EpisodeContents], key: str) -> list[Any]:
    """List the values of the attribute `key` in all episodes that have this attribute."""
    return [one.attributes[key] for one in episodes if key in one.attributes]


def format_plans(episodes: Sequence[EpisodeContents]) -> Iterator[str]:
    """Yield a section with the text of each plan that the files contain."""
    for text in dict.fromkeys(map(str, format_value(episodes, "plan"))):
        yield f"## Plan\n\n```toml\n{text.strip()}\n```\n"


# Section on limitations.
LIMITATIONS = """## Limitations

- The error of the simulated motion relative to a patient is unknown. Models are compared with FEM, not with a patient.
- Tissue stiffness and the constraints by skull and fluid are assumed, not measured.
- The images show no blood, smoke, other instruments or hands; the light is idealised.
- Tool forces follow from the assumed tissue; real forces may differ.
- Transfer of trained methods to real images is not tested. It requires real images.
"""
