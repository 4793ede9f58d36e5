"""Instructions -> token ids, one word each, padded to a fixed length.

The vocabulary travels in the checkpoint. It is built from all instructions of the environment, so a policy trained on
ten tasks can be fine-tuned on fifty without a new embedding.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

from kerv_cli.base.errors import UsageError

PAD, UNKNOWN = 0, 1


@dataclass(frozen=True)
class WordTokenizer:
    """A fixed vocabulary of whole words."""

    words: tuple[str, ...]  # word of id i + 2; ids 0 and 1 are padding and unknown

    @classmethod
    def build(cls, sentences: Iterable[str]) -> WordTokenizer:
        """The vocabulary of the sentences' lower-case words, sorted."""
        return cls(tuple(sorted({word for s in sentences for word in s.lower().split()})))

    @property
    def size(self) -> int:
        """Number of ids: words, padding and unknown."""
        return len(self.words) + 2

    @cached_property
    def index(self) -> dict[str, int]:
        """Word -> id."""
        return {word: i + 2 for i, word in enumerate(self.words)}

    def encode(self, sentence: str, length: int) -> list[int]:
        """The sentence as exactly `length` ids, padded.

        Raises:
            UsageError: more words than `length`; truncating could drop the decisive one.
        """
        ids = [self.index.get(word, UNKNOWN) for word in sentence.lower().split()]
        if len(ids) > length:
            raise UsageError(f"instruction '{sentence}' has {len(ids)} words, the policy takes {length}: shorten it")
        return ids + [PAD] * (length - len(ids))
