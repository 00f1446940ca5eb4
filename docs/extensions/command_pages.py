"""The reference of the command line, from the parsers themselves."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from benchmarks.__main__ import BENCHMARKS, make_parser
from scenes.cli import COMMANDS, GROUPS, make_parsers
from scenes.options.help import HelpFormatter

WIDTH = 72
"""Characters of a line of code that a page shows."""


def command_pages() -> dict[str, str]:
    """Pages in Markdown by the place of their files: one for each command, and their list in groups."""
    _, parsers = make_parsers(*COMMANDS)
    whole = ["# Command line", "One page for each command, with the text of `sulcus COMMAND --help`."]
    for title, group in {
        **GROUPS,
        "Measurements of the project": {"benchmarks": "time and check the software"},
    }.items():
        links = "\n".join(f"| [{name}](commands/{name}.md) | {text} |" for name, text in group.items())
        tree = "\n".join(f"commands/{name}" for name in group)
        whole += [
            f"## {title}",
            f"| command | purpose |\n|---|---|\n{links}",
            f"```{{toctree}}\n:hidden:\n\n{tree}\n```",
        ]
    pages = {f"commands/{name}.md": _page(name, parser) for name, parser in parsers.items()}
    pages["commands/benchmarks.md"] = _page("python -m benchmarks", make_parser(*BENCHMARKS))
    return {"command-line.md": "\n\n".join(whole) + "\n", **pages}


def _page(name: str, parser: argparse.ArgumentParser) -> str:
    return "\n\n".join(_section(name, parser, "#")) + "\n"


def _section(name: str, parser: argparse.ArgumentParser, level: str) -> Iterator[str]:
    yield f"{level} {name}"
    if parser.description:
        yield _words(parser.description)
    formatter = HelpFormatter(parser.prog, width=WIDTH)
    formatter.add_usage(parser.usage, parser._actions, parser._mutually_exclusive_groups)
    yield _code(formatter.format_help().strip())
    for group in parser._action_groups:
        rows = [row for action in group._group_actions if (row := _row(action, formatter))]
        if rows:
            title = (group.title or "").partition(";")[0].capitalize()
            yield f"**{title}.** {_words(group.description or '')}".strip()
            yield "\n\n".join(rows)
    if parser.epilog:
        yield _code(parser.epilog)
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for inner, command in action.choices.items():
                yield from _section(f"{name} {inner}", command, level + "#")


def _row(action: argparse.Action, formatter: HelpFormatter) -> str | None:
    """Return an argument and its help as a definition; None of `--help`."""
    if isinstance(action, argparse._HelpAction | argparse._SubParsersAction) or action.help == argparse.SUPPRESS:
        return None
    names = formatter._format_action_invocation(action).replace(", ", "`, `")
    needed = "**needed** " if action.required and action.option_strings else ""
    return f"`{names}`\n: {needed}{_words(formatter._expand_help(action))}" if action.help else f"`{names}`"


def _words(text: str) -> str:
    """Text in one line, in which no character is Markdown's but the backtick."""
    return " ".join(text.replace("*", "\\*").replace("<", "\\<").split())


def _code(text: str) -> str:
    return f"```text\n{text}\n```"
