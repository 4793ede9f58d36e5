"""How often one verification picks other tokens than single forwards: ties that the number format flips."""

from collections.abc import Sequence

import numpy as np
import torch

from kerv_cli.bench.model import Model
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.engine.draft import Draft
from kerv_cli.engine.proposer import Proposer


class Given(Proposer):
    """Drafts a chain of given tokens."""

    name = "given"

    def __init__(self, tokens: Sequence[int]) -> None:
        self.tokens = tokens

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        """The rest of the tokens, as far as there is room for them."""
        rest = self.tokens[len(chunk.tokens) :][:depth]
        return Draft.of(rest, range(-1, len(rest) - 1))


@torch.inference_mode()
def flipped(model: Model, chunks: int) -> tuple[int, int]:
    """Tokens whose argmax in one verification differs from that of single forwards, and tokens compared. The images are
    noise."""
    generator, differ, compared = np.random.default_rng(0), 0, 0
    for _ in range(chunks):
        seen = model.observation.images.items()
        images = {name: generator.integers(0, 256, image.shape, np.uint8) for name, image in seen}
        observation = model.observation.with_images(images)
        tokens = Decoder(model.target).decode(observation).tokens
        again = Decoder(model.target, Parts(proposer=Given(tokens))).decode(observation)
        differ += sum(one.accepted < len(one.drafted) for one in again.rounds)
        compared += len(tokens)
    return differ, compared
