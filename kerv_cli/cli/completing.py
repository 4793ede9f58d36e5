"""Completion of a command line: groups, names, keys and tasks, of the command at hand only."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from kerv_cli.base.registry import NoSettings, Part, parts
from kerv_cli.base.settings import choices_of
from kerv_cli.cli.command import commands_below, schemas_of, top_keys


def completions(command: str, typed: Sequence[str], incomplete: str) -> list[str]:
    """`me` -> `method=`; `method=s` -> every method that begins so; `threshold.` -> the keys of the chosen threshold.

    Args:
        command: e.g. `rollout`, `train drafter`.
        typed: the overrides in front of it: a chosen part has keys of its own.
    """
    part = parts("command")[command]
    key, equals, _ = incomplete.partition("=")
    if equals:
        words = [f"{key}={name}" for name in _values(part, key)]
    elif "." in incomplete:
        words = [f"{name}=" for name in _keys(part, typed, incomplete)]
    else:
        keys = [] if part.settings is NoSettings else [f"{name}=" for name in top_keys(part)]
        below = [] if typed else [one.name.removeprefix(f"{command} ") for one in commands_below(f"{command} ")]
        words = [*part.traits.get("completes", list)(), *below, *keys]
    return [word for word in dict.fromkeys(words) if word.startswith(incomplete)]


def _values(part: Part, key: str) -> list[str]:
    if key == "task":
        from kerv_cli.worlds import task_names

        return list(task_names())
    if key in part.traits.get("values", {}):
        return list(part.traits["values"][key]())
    if key == "world.stress.kind":
        return list(parts("stress"))
    for _, schema in schemas_of(part):
        if key in choices_of(schema):
            from kerv_cli.base.config import groups

            return groups()[key]
        for at in fields(schema):
            if at.name == key and "names" in at.metadata:
                return list(at.metadata["names"])
    return []


def _keys(part: Part, typed: Sequence[str], incomplete: str) -> list[str]:
    """Dotted keys of the command with the parts that were chosen in front."""
    from kerv_cli.base.config import keys_of

    for name, schema in schemas_of(part):
        if incomplete.split(".")[0] in {at.name for at in fields(schema)}:
            choices = [word for word in typed if word.split("=", 1)[0] in choices_of(schema)]
            return keys_of(name.replace(" ", "_"), choices, schema)
    return []


BASH = """# completion of kerv for bash. '=' ends a word for bash and not for kerv, so the line is split at blanks here.
_kerv_completion() {
    local line=${COMP_LINE:0:COMP_POINT} current words
    read -ra words <<<"$line"
    [[ $line == *[[:space:]] ]] && words+=("")
    local place=$((${#words[@]} - 1))
    current=${words[place]}
    local IFS=$'\\n'
    local typed
    typed=$(IFS=' '; echo "${words[*]}")
    COMPREPLY=($(env COMP_WORDS="$typed" COMP_CWORD=$place _KERV_COMPLETE=complete_bash "$1"))
    if [[ $current == *=* && $COMP_WORDBREAKS == *=* ]]; then
        COMPREPLY=("${COMPREPLY[@]#"${current%"${current##*=}"}"}")
    fi
    if [[ ${#COMPREPLY[@]} == 1 && ${COMPREPLY[0]} == *[=.] ]]; then compopt -o nospace 2>/dev/null; fi
    return 0
}
complete -o nosort -F _kerv_completion kerv
"""
SHELLS = ("bash", "zsh", "fish")


def script(shell: str) -> str:
    """The completion script of a shell."""
    from typer.completion import get_completion_script

    return BASH if shell == "bash" else get_completion_script(
        prog_name="kerv", complete_var="_KERV_COMPLETE", shell=shell
    )  # fmt: skip


def script_path(shell: str) -> Path:
    """Where the shell finds the script by itself: bash with the package bash-completion, fish; zsh below ~/.zfunc."""
    home = Path.home()
    data = Path(os.environ.get("XDG_DATA_HOME", home / ".local/share"))
    config = Path(os.environ.get("XDG_CONFIG_HOME", home / ".config"))
    if shell == "bash":
        user = Path(os.environ.get("BASH_COMPLETION_USER_DIR", data / "bash-completion"))
        return user / "completions" / "kerv"
    return config / "fish/completions/kerv.fish" if shell == "fish" else home / ".zfunc" / "_kerv"
