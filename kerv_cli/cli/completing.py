"""Completion of a command line: groups, names, keys and tasks, of the command at hand only."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import typer

_SCHEMAS = {
    "rollout": "RolloutSettings",
    "sweep": "RolloutSettings",
    "demos": "DemosSettings",
    "train_target": "TrainTargetSettings",
    "train_drafter": "TrainDrafterSettings",
    "build_datastore": "BuildDatastoreSettings",
    "calibrate": "CalibrateSettings",
    "calibrate_risk": "CalibrateRiskSettings",
    "train_score": "TrainScoreSettings",
    "report": "ReportSettings",
    "doctor": "DoctorSettings",
    "view": "ViewSettings",
    "bench": "BenchSettings",
    "serve": "ServeSettings",
}
"""Command -> name of its settings' class."""
_OF_THE_SWEEP = ("study", "until", "loss")


def complete_overrides(ctx: typer.Context, incomplete: str) -> list[str]:
    """Completions of an override, for the command that is typed."""
    command = "_".join(ctx.command_path.split()[1:])
    return completions(command, list(ctx.params.get("overrides") or []), incomplete)


def completions(command: str, typed: Sequence[str], incomplete: str) -> list[str]:
    """`me` -> `method=`; `method=s` -> every method that begins so; `threshold.` -> the keys of the chosen threshold.

    Args:
        command: e.g. `rollout`, `train_drafter`.
        typed: the overrides in front of it: a chosen part has keys of its own.
    """
    if command not in _SCHEMAS:
        return []
    key, equals, _ = incomplete.partition("=")
    if equals:
        words = [f"{key}={name}" for name in _values(command, key)]
    elif "." in incomplete:
        words = [f"{name}=" for name in _keys(command, typed)]
    else:
        words = [f"{name}=" for name in _top(command)]
    return [word for word in dict.fromkeys(words) if word.startswith(incomplete)]


def groups_of(command: str) -> dict[str, list[str]]:
    """The groups that the command's defaults choose from, and the names in them."""
    import yaml

    from kerv_cli.base.config import conf_dir, groups

    names_of = groups()
    files = ("rollout", "sweep") if command == "sweep" else (command,)
    used: list[str] = []
    for file in files:
        defaults = yaml.safe_load((conf_dir() / f"{file}.yaml").read_text(encoding="utf-8")).get("defaults", [])
        used += [name for choice in defaults if isinstance(choice, dict) for name in choice]
    return {name: names_of[name] for name in used if name in names_of}


def _values(command: str, key: str) -> list[str]:
    if key == "task":
        from kerv_cli.worlds import task_names

        return list(task_names())
    if key == "study" and command == "report":
        results = Path("results/studies")
        return sorted(path.parent.name for path in results.glob("*/plan.yaml"))
    if key == "world.stress.kind":
        from kerv_cli.base.registry import parts

        return list(parts("stress"))
    if key == "until":
        return ["decided", "done"]
    return groups_of(command).get(key, [])


def _top(command: str) -> list[str]:
    """Groups and plain keys of the first level; a mapping is written with a dot behind it."""
    from kerv_cli.base import settings

    names = [field.name for field in fields(getattr(settings, _SCHEMAS[command]))]
    extra = _OF_THE_SWEEP if command == "sweep" else ("study",) if command == "report" else ()
    return [*groups_of(command), *extra, *names]


def _keys(command: str, typed: Sequence[str]) -> list[str]:
    """Dotted keys of the command with the parts that were chosen in front."""
    from kerv_cli.base import settings
    from kerv_cli.base.config import keys_of

    composed = "rollout" if command == "sweep" else command
    choices = [word for word in typed if word.split("=", 1)[0] in groups_of(composed)]
    return keys_of(composed, choices, getattr(settings, _SCHEMAS[composed]))


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
