"""topoloc --completion SHELL: a script that completes commands and options with the Tab key."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import re
import sys
from collections.abc import Sequence
from dataclasses import fields
from typing import Literal, get_args, get_origin, get_type_hints

from topoloc.apps.cli import all_commands, main

# Words that match nothing leave it to the shell to complete names of files.
_BASH = """\
_topoloc() {{
    local word=${{COMP_WORDS[COMP_CWORD]}} words=""
    case "$COMP_CWORD ${{COMP_WORDS[1]}} $word" in
        "1 "*) words="{commands}" ;;
{cases}
    esac
    COMPREPLY=($(compgen -W "$words" -- "$word"))
}}
complete -o default -F _topoloc topoloc
"""
_ZSH = """\
(( $+functions[compdef] )) || { autoload -Uz compinit && compinit; }
autoload -Uz bashcompinit && bashcompinit
"""


def print_completion(args: list[str]) -> int:
    """Print the script of the shell that is named. Return the exit status, 2 if it has none."""
    if args not in (["bash"], ["zsh"], ["fish"]):
        print("error: --completion takes the name of a shell: bash, zsh or fish", file=sys.stderr)
        return 2
    os.environ["COLUMNS"] = "500"  # no option of a text stands at the beginning of its line
    commands = all_commands()
    options = {name: _find_options(name) for name in commands}
    actions = {name: _find_actions(module) for name, (module, _) in commands.items()}
    if args == ["fish"]:
        for name, (_, text) in commands.items():
            print("\n".join(_fish_lines(name, text, options[name], actions[name])))
        return 0
    cases = [f'        *" {name} -"*) words="{" ".join(options[name])}" ;;' for name in commands]
    for name, words in actions.items():
        if words:
            cases.append(f'        "2 {name} "*) words="{" ".join(words)}" ;;')
    bash = _BASH.format(commands=" ".join(commands), cases="\n".join(cases))
    print((_ZSH if args == ["zsh"] else "") + bash, end="")
    return 0


def _fish_lines(name: str, summary: str, options: list[str], actions: Sequence[str]) -> list[str]:
    text, given = summary.replace("'", ""), f"__fish_seen_subcommand_from {name}"
    lines = [f"complete -c topoloc -n __fish_use_subcommand -f -a {name} -d '{text}'"]
    lines += [f"complete -c topoloc -n '{given}' -l {one[2:]}" for one in options]
    if actions:
        first = f"{given}; and test (count (commandline -opc)) -eq 2"
        lines.append(f"complete -c topoloc -n '{first}' -f -a '{' '.join(actions)}'")
    return lines


def _find_options(name: str) -> list[str]:
    """Return the options that the help of a command lists, none if it cannot be loaded."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        main([name, "--help"])
    found = re.findall(r"^\W*(--[a-z][\w-]*)", printed.getvalue(), re.MULTILINE)
    return ["--help", *found]


def _find_actions(module: str) -> Sequence[str]:
    """Return the words of which the first argument of a command is one."""
    with contextlib.suppress(ImportError):
        command = importlib.import_module(module).Command
        kind = get_type_hints(command)[fields(command)[0].name]
        return get_args(kind) if get_origin(kind) is Literal else ()
    return ()
