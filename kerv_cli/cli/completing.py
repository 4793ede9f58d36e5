"""The shells' completion scripts."""

from __future__ import annotations

import os
from pathlib import Path

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
