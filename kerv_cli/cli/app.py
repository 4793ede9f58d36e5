"""The `kerv` command with all registered subcommands. Neither torch nor MuJoCo is imported here.

Each of kerv's own commands is in a file of this folder, which is imported when the command is typed.
"""

from __future__ import annotations

import os
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from kerv_cli.base.errors import UnknownName
from kerv_cli.cli.command import CONTEXT, FastFlags, commands, typer_command
from kerv_cli.cli.common import one_line_errors

# Set before numpy loads: by default its matrix multiplications use every core, whatever runtime.threads says.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# help of groups of commands, such as `kerv train`, that do nothing by themselves
FAMILIES = {
    "train": "Train the target or a drafter.",
    "build": "Build artifacts that need no training.",
    "runs": "List, show, export and remove runs: sweeps, rollouts, trainings, all that was made.",
}


class Commands(FastFlags, TyperGroup):
    """A group of registered commands: all of `kerv`, or those whose names begin with `prefix`, such as `train `."""

    prefix = ""

    def list_commands(self, ctx: Any) -> list[str]:
        return list(dict.fromkeys(name.removeprefix(self.prefix).split()[0] for name in commands(self.prefix.strip())))

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        name = self.prefix + cmd_name
        below = commands(name)
        if name in below:
            return typer_command(below[name])
        if not below:
            return None
        help = FAMILIES.get(name)
        family = Commands(name=cmd_name, help=help, short_help=help, no_args_is_help=True, rich_markup_mode=None)
        family.context_settings, family.prefix = CONTEXT, f"{name} "
        return family

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        name = " ".join(args[:2])  # names of two words, as in `demos import`, are tried first
        command = self.get_command(ctx, name) if len(args) > 1 else None
        if command is not None:
            return name, command, args[2:]
        command = self.get_command(ctx, args[0])
        if command is None and not ctx.resilient_parsing:
            raise UnknownName(f"{self.prefix}command", args[0], self.list_commands(ctx))
        return args[0], command, args[1:]


class Kerv(Commands):
    """The command `kerv` itself. It runs the command that was typed, and prints each error as one line."""

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        self.words = list(args)
        with one_line_errors(self.words):
            return super().make_context(info_name, args, parent, **extra)

    def invoke(self, ctx: Any) -> Any:
        with one_line_errors(self.words):
            return super().invoke(ctx)()


app = typer.Typer(
    cls=Kerv,
    name="kerv",
    help="Fast vision-language-action policies on Meta-World: train, sweep, report, look.",
    epilog="Settings follow the command as key=value, e.g. kerv rollout method=spec_vla task=drawer-open threshold.r=5",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings=CONTEXT,
)


def _version(chosen: bool) -> None:
    if chosen:
        from kerv_cli.targets.provenance import git_commit, versions

        typer.echo(f"{', '.join(map(' '.join, versions().items()))}, commit {git_commit()}")
        raise typer.Exit(0)


@app.callback()
def kerv(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print versions and stop.")
    ] = False,
) -> None:
    """Accept the options of `kerv` itself."""


program = typer.main.get_command(app)
