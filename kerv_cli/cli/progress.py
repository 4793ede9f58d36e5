"""Show the progress of a running study: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from types import TracebackType

from rich import progress as bars
from rich.console import Console
from rich.markup import escape

from kerv_cli.base.durations import count, left
from kerv_cli.lab.events import BlockEnded, BlockStarted, BlockWaits, EpisodeEnd, Event, SettingFailed, Started
from kerv_cli.lab.plan import Block, Setting

LOG_SECONDS = 30.0
"""Minimum seconds between two lines of progress if there is no terminal."""


class ProgressDisplay:
    """Progress display of a study. Pass it to `study.run` as the callback for events, inside a `with` block.

    The bar counts episodes. `on_step` moves it within an episode that runs in this process.

    Args:
        console: Where to print. None: standard error.
    """

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or Console(stderr=True)
        self._bar: bars.Progress | None = None
        self._task = bars.TaskID(0)
        self._total = self._ended = 0  # numbers of episodes
        self._part = 0.0  # finished share of the episode that runs in this process
        self._began = self._logged = 0.0
        self._blocks: dict[int, Block] = {}

    def __enter__(self) -> ProgressDisplay:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, event: Event) -> None:
        """Show an event of the study, such as the end of an episode."""
        if isinstance(event, Started):
            self._start(event)
        elif isinstance(event, BlockStarted):
            self._blocks[id(event.block)] = event.block
        elif isinstance(event, BlockEnded):
            self._blocks.pop(id(event.block), None)
        elif isinstance(event, BlockWaits):
            self._print(f"{event.block.name}: another sweep computes it")
        elif isinstance(event, SettingFailed):
            one = event.episodes[0]
            self._ended += len(event.episodes)
            self._print(f"{escape(one.setting.label)} on {one.task}: [red]failed[/red]: {escape(event.reason)}")
        else:
            self._finish(event)
        self._show(self._now)

    def on_step(self, setting: Setting, task: str, seed: int, step: int) -> None:
        """Show the progress of the episode that runs in this process.

        Args:
            setting: Setting of the study.
            task: Name of the task.
            seed: Seed of the episode.
            step: Number of control steps executed so far.
        """
        horizon = int(setting.settings["world"]["horizon"])
        # relative to the maximum length: the bar jumps when an episode succeeds earlier
        self._part = min(1.0, step / max(1, horizon))
        self._show(f"{escape(setting.label)} on {task}, seed {seed}: step {step}")

    def _finish(self, end: EpisodeEnd) -> None:
        self._ended, self._part = self._ended + 1, 0.0
        one = end.episode
        what = f"{escape(one.setting.label)} on {one.task}, seed {one.seed}"
        if end.elsewhere:
            self._print(f"{what}: run by another sweep")
        elif self.console.is_terminal or self._total <= 100:
            result = "success" if end.success else "failure"
            self._print(
                f"[dim]{self._ended:{len(str(self._total))}}/{self._total}[/dim] {what}: {result}, {end.seconds:.1f} s"
            )

    def _print(self, line: str) -> None:
        self.console.print(line, soft_wrap=True, highlight=False)

    def _show(self, now: str) -> None:
        """Move the bar. If there is none, print a line, but at most one per LOG_SECONDS.

        Args:
            now: What is running at the moment.
        """
        if self._bar is not None:
            self._bar.update(self._task, completed=self._ended + self._part, count=self._count, description=now)
        elif time.monotonic() - self._logged > LOG_SECONDS:
            self._logged = time.monotonic()
            done = self._ended + self._part
            rest = f"{left(self._logged - self._began, max(done, 0.1), self._total)}; " if done else ""
            self._print(f"{self._count}, {rest}{now}")

    @property
    def _count(self) -> str:
        return f"{self._ended}/{self._total} episodes"

    def _start(self, event: Started) -> None:
        self._total, self._ended, self._part = event.to_run, 0, 0.0
        self._began = self._logged = time.monotonic()
        if self._bar is not None:
            self._bar.stop()
        if event.reused:
            self._print(f"{count(event.reused, 'episode')} there already")
        if not self.console.is_terminal or not event.to_run:
            return
        texts = [bars.TextColumn(text) for text in ("{task.description}", "{task.fields[count]}", "left")]
        times = (bars.TimeElapsedColumn(), texts[2], bars.TimeRemainingColumn())
        columns = (bars.SpinnerColumn(), texts[0], bars.BarColumn(), texts[1], *times)
        self._bar = bars.Progress(*columns, console=self.console, transient=True)
        self._task = self._bar.add_task("preparing", total=event.to_run, count=self._count)
        self._bar.start()

    @property
    def _now(self) -> str:
        names = [block.title for block in self._blocks.values()]
        more = f" +{len(names) - 1}" if len(names) > 1 else ""
        return escape(names[0] + more if names else "episodes")
