"""Help of commands: sections, defaults, metavars, and former names of options."""

import re

import pytest

from scenes.cli import COMMANDS, main, make_parsers
from scenes.options.help import FORMER, SECTIONS, CommandParser, replace_former_options


def test_help_has_sections_defaults_and_metavars():
    parser = CommandParser(prog="x")
    parser.add_argument("--out", help="output file")
    parser.add_argument("--young", type=float, help="Young's modulus [Pa]")
    parser.add_argument("--count", type=int, default=3, help="number of loads")
    parser.add_argument("--full", action="store_true", help="all of it")
    parser.add_argument("--base", default=5, help="base (default: of the file)")
    text = " ".join(parser.format_help().split())
    assert "options: -h, --help show this help message and exit --count N number of loads (default: 3)" in text
    assert "--full all of it --base NAME base (default: of the file) tissue options: --young PA" in text
    assert text.endswith("output options: --out NAME output file")


def test_help_states_each_default_once():
    for name, parser in make_parsers(*COMMANDS)[1].items():
        text = " ".join(parser.format_help().split())
        assert not re.search(r"\(default: [^()]*\) \(default", text), name
        assert "[default" not in text and "(default " not in text.replace("(default shape", ""), name


def test_replacements_of_former_options_exist():
    parsers = make_parsers(*COMMANDS)[1]
    for command, pairs in FORMER.items():
        for pair in pairs.split():
            former, _, present = pair.partition(":")
            known = parsers[command or "demo"]._option_string_actions
            assert f"--{present}" in known and f"--{former}" not in known, (command, pair)
    known = {option for parser in parsers.values() for option in parser._option_string_actions}
    assert {name for names in SECTIONS.values() for name in names.split()} <= known


def test_former_option_is_replaced_with_a_notice(capsys):
    assert replace_former_options(["simulate", "a.vtu", "--preset=seed", "--poses"]) == [
        "simulate", "a.vtu", "--tool-preset=seed", "--pose-control",
    ]  # fmt: skip
    said = capsys.readouterr().err.splitlines()
    assert said == ["sulcus simulate: --preset is now --tool-preset", "sulcus simulate: --poses is now --pose-control"]
    kept = ["anatomy", "--preset", "deep"]
    assert replace_former_options(kept) == kept and not replace_former_options([])


def test_command_accepts_a_former_option(capsys):
    with pytest.raises(SystemExit):
        main(["demo", "--within-mm", "x"])
    assert "--within-error: invalid float value: 'x'" in capsys.readouterr().err
