"""Turn instructions into token ids, one per word, padded to a fixed length.

The vocabulary is stored in the checkpoint. It is built from all instructions of the environment, so a policy trained on
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
    """A fixed vocabulary of whole words.

    Attributes:
        words: The known words. `words[i]` has id i + 2. Id 0 is padding, id 1 stands for any unknown word.
    """

    words: tuple[str, ...]

    @classmethod
    def build(cls, sentences: Iterable[str]) -> WordTokenizer:
        """Return a tokenizer for all lower-case words of the sentences, in alphabetical order."""
        return cls(tuple(sorted({word for s in sentences for word in s.lower().split()})))

    @property
    def size(self) -> int:
        """Number of ids: one per word, one for padding, and one for unknown words."""
        return len(self.words) + 2

    @cached_property
    def index(self) -> dict[str, int]:
        """Map from a word to its id."""
        return {word: i + 2 for i, word in enumerate(self.words)}

    def encode(self, sentence: str, length: int) -> list[int]:
        """Return exactly `length` ids for a sentence, with padding at the end.

        Raises:
            UsageError: The sentence has more than `length` words. It is not cut, because a decisive word could be lost.
        """
        ids = [self.index.get(word, UNKNOWN) for word in sentence.lower().split()]
        if len(ids) > length:
            raise UsageError(f"instruction '{sentence}' has {len(ids)} words, the policy takes {length}: shorten it")
        return ids + [PAD] * (length - len(ids))
