"""`kerv completion`: completion of the command line, without a change to a start-up file where the shell allows it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.base.files import write_text
from kerv_cli.base.registry import NoSettings
from kerv_cli.cli.command import command

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


Install = Annotated[bool, typer.Option("--install", help="Put the script where the shell looks for it.")]


@command(
    "completion",
    NoSettings,
    examples=("kerv completion bash --install", "kerv completion zsh"),
    names="NAME: bash, zsh or fish.",
    completes=lambda: list(SHELLS),
)
def completion(names: list[str], install: Install = False) -> None:
    """Print a shell's completion script, or install it for this user."""
    if len(names) != 1:
        raise UsageError(f"name one shell: {', '.join(SHELLS)}")
    shell = names[0]
    if shell not in SHELLS:
        raise UnknownName("shell", shell, SHELLS)
    if not install:
        typer.echo(script(shell))
        return
    path = script_path(shell)
    write_text(path, script(shell) + "\n")
    typer.echo(f"{path}: a new {shell} completes kerv")
    if shell == "zsh":
        typer.echo("if it does not, ~/.zshrc needs this line: fpath+=~/.zfunc; autoload -Uz compinit && compinit")
    if shell == "bash":
        typer.echo("it is read by the package bash-completion, which most distributions install")
