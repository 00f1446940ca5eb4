"""The reference of the command line, from the parsers themselves."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from functools import partial

from benchmarks.__main__ import BENCHMARKS, make_parser
from scenes.cli import COMMANDS, make_parsers

WIDTH = 72
"""Characters of a line of code that a page shows."""


def command_page() -> str:
    """A page in Markdown: a section for each command, with its usage, its arguments and its examples."""
    _, parsers = make_parsers(*COMMANDS)
    whole = ["# Command line", "What `sulcus COMMAND --help` prints, of every command. In words: {doc}`/commands`."]
    for name, parser in {**parsers, "python -m benchmarks": make_parser(*BENCHMARKS)}.items():
        whole += _section(name, parser, "##")
    return "\n\n".join(whole) + "\n"


def _section(name: str, parser: argparse.ArgumentParser, level: str) -> Iterator[str]:
    yield f"{level} {name}"
    if parser.description:
        yield _words(parser.description)
    parser.formatter_class = partial(argparse.HelpFormatter, width=WIDTH)
    yield _code(parser.format_usage().strip())
    for group in parser._action_groups:
        rows = [row for action in group._group_actions if (row := _row(action))]
        if rows:
            title = (group.title or "").capitalize()
            yield f"**{title}.** {_words(group.description or '')}".strip()
            yield "\n\n".join(rows)
    if parser.epilog:
        yield _code(parser.epilog)
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for inner, command in action.choices.items():
                yield from _section(f"{name} {inner}", command, level + "#")


def _row(action: argparse.Action) -> str | None:
    """A name and what it means, as a definition; None of `--help`, which all have."""
    if isinstance(action, argparse._HelpAction | argparse._SubParsersAction) or action.help == argparse.SUPPRESS:
        return None
    value = _value(action)
    if action.option_strings:
        name = ", ".join(f"`{option} {value}`" if value else f"`{option}`" for option in action.option_strings)
    else:
        name = f"`{value}`"
    text = (action.help or "") % {**vars(action), "prog": "sulcus"}
    needed = "**needed** " if action.required and action.option_strings else ""
    return f"{name}\n: {needed}{_words(text)}" if text else name


def _value(action: argparse.Action) -> str:
    if action.nargs == 0:
        return ""
    if action.choices is not None and action.metavar is None:
        return "{" + ",".join(map(str, action.choices)) + "}"
    shown = action.metavar or (action.dest.upper() if action.option_strings else action.dest)
    return " ".join(shown) if isinstance(shown, tuple) else shown


def _words(text: str) -> str:
    """Text in one line, in which no character is Markdown's but the backtick."""
    return " ".join(text.replace("*", "\\*").replace("<", "\\<").split())


def _code(text: str) -> str:
    return f"```text\n{text}\n```"
