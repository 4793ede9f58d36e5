"""A method: check that its parts fit together, and build the decoder from them (docs/methods.md)."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from kerv_cli.base import registry
from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import check_settings
from kerv_cli.methods.context import Context
from kerv_cli.methods.settings import MethodSettings

if TYPE_CHECKING:
    from kerv_cli.engine.decoder import Decoder
    from kerv_cli.engine.protocol import Target
    from kerv_cli.targets.checkpoint import TargetDescription


@dataclass(frozen=True)
class Method:
    """A decoding method: one part of each kind, such as proposer, acceptance and skip.

    Attributes:
        settings: Settings of the parts, by kind, for all kinds in METHOD_KINDS.
        chunk: Number of control steps per chunk. If 0, as many as the target was trained for.
        name: Name of the method, for messages.
    """

    settings: Mapping[str, Any]
    chunk: int = 0
    name: str = ""

    @classmethod
    def of(cls, settings: MethodSettings) -> Method:
        return cls(settings.parts(), settings.chunk, settings.method)

    @functools.cached_property
    def parts(self) -> dict[str, Any]:
        return {kind: registry.part_of(kind, self.settings[kind].kind) for kind in registry.METHOD_KINDS}

    @property
    def needs(self) -> tuple[str, ...]:
        kinds: list[str] = []
        for kind, part in self.parts.items():
            kinds += part.needed(self.settings[kind])
        return tuple(dict.fromkeys(kinds))

    def check(self, target: Target | TargetDescription) -> None:
        """Refuse parts that do not work together or with the target, and numbers out of range. Loads no weights."""
        from kerv_cli.engine.chunk import chunk_steps  # imports numpy, which a mistyped key must not wait for

        for kind in self.parts:
            check_settings(self.settings[kind], kind)
        chunk_steps(self.chunk, target.chunk)
        for kind, part in self.parts.items():
            part.check_code(kind, bool(target.actions.code))
        draft, proposer, skip, boundary = (
            self.parts[kind] for kind in ("prefill_draft", "proposer", "skip", "boundary")
        )
        threshold, most = self.settings["threshold"], target.actions.tokens - 1
        name = self.parts["threshold"].radius
        if name and getattr(threshold, name) > most:
            raise UsageError(f"threshold.{name}={getattr(threshold, name)}: bins from 0 to {most}")
        if proposer.has_boundary != boundary.chooses:
            raise UsageError(
                f"proposer={proposer.name} with boundary={boundary.name}: "
                + ("name a boundary that chooses" if proposer.has_boundary else "nothing to choose from")
            )
        if draft.when != registry.PREFILL:
            raise UsageError(
                f"prefill_draft={draft.name}: it reads the target's states, which come after the prefill; use it as "
                f"proposer={draft.name}"
            )
        parallel = getattr(target, "parallel", False)
        if skip.name == "parallel" and not parallel:
            raise UsageError(
                "skip=parallel: this target decodes token by token. Use policy=parallel, or train a parallel target "
                "with kerv train target target.parallel=true"
            )
        if parallel and skip.name != "parallel":
            raise UsageError("this target decodes all tokens at once and nothing else: use method=parallel")
        for kind in ("prefill_draft", "proposer"):
            if parallel and not self.parts[kind].absent:
                name = self.parts[kind].name
                raise UsageError(f"skip=parallel with {kind}={name}: nothing is drafted, leave it out")
        if skip.takes_draft and not draft.chains and not (skip.merges and draft.merged):
            raise UsageError(
                f"skip={skip.name} with prefill_draft={draft.name}: it executes a draft from before the prefill"
            )

    def decoder(self, target: Target, artifact: Callable[[str], Any], task: str = "") -> Decoder:
        """Build the decoder. `artifact` loads the artifact of a kind, and is called only for the kinds in `needs`."""
        from kerv_cli.engine.decoder import Decoder, Parts

        self.check(target)
        context = Context(target, artifact, task, chunk=self.chunk)
        for kind, part in self.parts.items():
            context.built[kind] = part.built(self.settings[kind], context)
        return Decoder(target, Parts(**context.built), self.chunk)
