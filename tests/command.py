"""The command line in this process, which has loaded the libraries already, and in one of its own."""

import os
import subprocess
import sys

from click.testing import Result
from typer.testing import CliRunner

from kerv_cli.cli.app import app


def kerv(*words: str, code: int | None = 0) -> Result:
    """Run a command and check its exit code; None allows any."""
    run = CliRunner().invoke(app, list(words))
    assert code in (None, run.exit_code), run.output
    return run


def told(*words: str, code: int | None = 0) -> str:
    """Return all that a command prints."""
    return str(kerv(*words, code=code).output)


def refusal(*words: str, code: int | None = None) -> str:
    """Return the one line in which a command refuses, with exit code 1 or 2."""
    run = kerv(*words, code=code)
    assert run.exit_code in (1, 2), run.output
    (line,) = [line for line in run.stderr.splitlines() if line.startswith("kerv: ")]
    return line


def process(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run Python with these arguments in a process of its own."""
    command = [sys.executable, "-W", "ignore", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, env={**os.environ, **environment})
