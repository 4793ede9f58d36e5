"""`kerv completion`: completion of the command line, without a change to a start-up file where the shell allows it."""

from __future__ import annotations

from typing import Annotated

import typer

from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.base.files import atomic_path
from kerv_cli.base.registry import NoSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.completing import SHELLS, script, script_path

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
    with atomic_path(path) as temporary:
        temporary.write_text(script(shell) + "\n", encoding="utf-8")
    typer.echo(f"{path}: a new {shell} completes kerv")
    if shell == "zsh":
        typer.echo("if it does not, ~/.zshrc needs this line: fpath+=~/.zfunc; autoload -Uz compinit && compinit")
    if shell == "bash":
        typer.echo("it is read by the package bash-completion, which most distributions install")
