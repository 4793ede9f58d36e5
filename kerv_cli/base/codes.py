"""FAST tokens: a sequence of tokens encodes all actions of a chunk together (docs/methods.md §0.3).

Notation: D degrees of freedom (DoFs) of an action, H control steps of a chunk, V different tokens.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

SCALE = 10.0  # factor by which the cosine coefficients are multiplied before they are rounded (FAST §4.3)
VOCABULARY = 1024  # number of tokens of a learnt code, the end token included, as in FAST
# Unicode code point of the character for token 0. To learn or apply merges, each coefficient becomes a character.
FIRST = 0x4E00


@dataclass(frozen=True)
class FastCode:
    """FAST: byte-pair merges of quantised cosine coefficients (Pertsch et al. 2025, arXiv 2501.09747, §4).

    The cosine transform along time turns a chunk of normalised actions into H coefficients per DoF. The coefficients
    are scaled, rounded, and ordered by frequency, all DoFs of the lowest frequency first. A merge replaces a frequent
    pair of neighbouring tokens by one new token.

    Unlike FAST, kerv drops the zeros at the end of a sequence, and puts an end token in their place. So sequences
    differ in length, and the first tokens of a sequence alone stand for a complete, coarser motion.

    Args:
        steps: H, control steps of a chunk.
        dofs: D, degrees of freedom of an action.
        scale: Factor by which the coefficients are multiplied before they are rounded.
        merges: For each merged token, the two tokens that it joins. Tokens 0, 1, … are the rounded coefficients from
            the lowest to the highest. The merged tokens follow, then the end token.

    Raises:
        ValueError: A merge joins a token that does not come before the merged token.
    """

    steps: int
    dofs: int
    scale: float
    merges: tuple[tuple[int, int], ...] = ()

    def __post_init__(self) -> None:
        for token, pair in enumerate(self.merges, 2 * self.highest + 1):
            if not 0 <= min(pair) <= max(pair) < token:
                raise ValueError(f"the merge {pair} names a token that comes after it")

    @classmethod
    def learn(cls, chunks: np.ndarray) -> FastCode:
        """Learn merges from n chunks (n, H, D) of normalised actions. The code fits chunks of the same H and D."""
        from tokenizers import Tokenizer, models, trainers

        plain, merges = cls(chunks.shape[1], chunks.shape[2], SCALE), []
        letters, size = plain.spellings, max(plain.end, VOCABULARY - 1)  # without the end token
        tokenizer = Tokenizer(models.BPE())
        trainer = trainers.BpeTrainer(vocab_size=size, initial_alphabet=letters, show_progress=False)
        tokenizer.train_from_iterator(plain.texts(plain.coefficients(chunks)), trainer)
        numbers = {letter: token for token, letter in enumerate(letters)}
        for first, second in json.loads(tokenizer.to_str())["model"]["merges"]:
            merges.append((numbers[first], numbers[second]))
            numbers[first + second] = len(numbers)
        return cls(plain.steps, plain.dofs, plain.scale, tuple(merges))

    @property
    def highest(self) -> int:
        return math.ceil(self.scale * math.sqrt(self.steps))

    @property
    def end(self) -> int:
        return 2 * self.highest + 1 + len(self.merges)

    @property
    def tokens(self) -> int:
        return self.end + 1

    @property
    def longest(self) -> int:
        return self.steps * self.dofs + 1

    @cached_property
    def parts(self) -> list[tuple[int, ...]]:
        parts: list[tuple[int, ...]] = [(value,) for value in range(-self.highest, self.highest + 1)]
        for first, second in self.merges:
            parts.append(parts[first] + parts[second])
        return [*parts, ()]

    @property
    def spellings(self) -> list[str]:
        texts = list(map(chr, range(FIRST, FIRST + 2 * self.highest + 1)))
        for first, second in self.merges:
            texts.append(texts[first] + texts[second])
        return texts

    @cached_property
    def tokenizer(self) -> Any:
        from tokenizers import Tokenizer, models

        texts = self.spellings
        pairs = [(texts[first], texts[second]) for first, second in self.merges]
        return Tokenizer(models.BPE({text: token for token, text in enumerate(texts)}, pairs))

    def coefficients(self, chunks: np.ndarray) -> np.ndarray:
        """Return the rounded coefficients (n, H · D) int64, lowest frequency first, of normalised chunks (n, H, D)."""
        from scipy.fft import dct

        return np.rint(dct(chunks, axis=1, norm="ortho") * self.scale).astype(np.int64).reshape(len(chunks), -1)

    def motions(self, coefficients: np.ndarray) -> np.ndarray:
        """Return the normalised actions (n, H, D) of coefficients (n, H · D). They are not clipped to [−1, 1]."""
        from scipy.fft import idct

        return idct(coefficients.reshape(-1, self.steps, self.dofs) / self.scale, axis=1, norm="ortho")

    def values(self, coefficients: Sequence[int]) -> np.ndarray:
        """Return the normalised actions (H, D), in [-1, 1], of up to H · D rounded coefficients. Missing ones are 0."""
        full = np.zeros(self.steps * self.dofs)
        full[: len(coefficients)] = coefficients
        return np.clip(self.motions(full)[0], -1.0, 1.0)

    def texts(self, coefficients: np.ndarray) -> Iterable[str]:
        """Yield a text for each row of coefficients (n, H · D): a character per coefficient, without final zeros."""
        for row in coefficients:
            yield "".join(map(chr, (FIRST + self.highest + np.trim_zeros(row, "b")).tolist()))

    def encode(self, coefficients: np.ndarray) -> np.ndarray:
        """Return the tokens (n, N) int64 of rounded coefficients (n, H · D).

        N is `longest`. End tokens fill shorter rows.
        """
        tokens = np.full((len(coefficients), self.longest), self.end)
        for row, encoded in enumerate(self.tokenizer.encode_batch(list(self.texts(coefficients)))):
            tokens[row, : len(encoded.ids)] = encoded.ids
        return tokens

    def decode(self, tokens: Sequence[int]) -> list[int]:
        """Return the rounded coefficients of the tokens before the first end token, at most H · D of them."""
        found: list[int] = []
        for token in tokens:
            if token == self.end:
                break
            found += self.parts[token]
        return found[: self.steps * self.dofs]


# For each kind of tokens, the function that learns its code from chunks (n, H, D) of normalised actions. The function
# of `bins` returns None, because every number of an action is then a token of its own.
CODES: dict[str, Callable[[np.ndarray], FastCode | None]] = {"bins": lambda chunks: None, "fast": FastCode.learn}
