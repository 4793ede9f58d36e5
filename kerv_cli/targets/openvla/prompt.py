"""Instructions to token ids: OpenVLA's prompt through the tokenizer.json of its folder.

The prompt ends with the token of a lone word boundary (id 29871 of Llama-2). The training data has it before the action
tokens, and a tokenizer leaves it out.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from kerv_cli.base.errors import CheckpointError, KervError, UsageError
from kerv_cli.targets.openvla.config import Shape

TOKENIZER = "tokenizer.json"
BEGIN, BOUNDARY = "<s>", "\u2581"
PROMPTS = {
    "openvla": "In: What action should the robot take to {}?\nOut:",
    "openvla_v01": (
        "A chat between a curious user and an artificial intelligence assistant. The assistant gives helpful, "
        "detailed, and polite answers to the user's questions. USER: What action should the robot take to {}? "
        "ASSISTANT:"
    ),
}
"""Text around the instruction by version. v0.1 checkpoints were trained with the second."""


class Prompter:
    """The prompt of one checkpoint."""

    def __init__(self, folder: Path, shape: Shape, form: str, limit: int) -> None:
        """Read the tokenizer.

        Args:
            folder: Folder of the checkpoint.
            shape: Its shape.
            form: Key of `PROMPTS`.
            limit: Most ids of a prompt.

        Raises:
            CheckpointError: There is no tokenizer, or that of another model.
            KervError: The package tokenizers is missing.
        """
        path = folder / TOKENIZER
        self.text, self.limit = PROMPTS[form], limit
        self.tokenizer = _tokenizer_of(path)
        size = self.tokenizer.get_vocab_size(with_added_tokens=False)
        self.begin, self.boundary = map(self.tokenizer.token_to_id, (BEGIN, BOUNDARY))
        if size != shape.vocabulary or None in (self.begin, self.boundary):
            raise CheckpointError(
                f"{path} has {size} ids, the weights are for {shape.vocabulary} of a Llama: it is another model's"
            )

    def ids(self, instruction: str) -> list[int]:
        """Return the prompt's ids: begin of sequence, the text, the word boundary.

        Raises:
            UsageError: The prompt is longer than `limit`. Cutting it could drop the decisive word.
        """
        ids: list[int] = self.tokenizer.encode(self.text.format(instruction.lower())).ids
        if ids[:1] != [self.begin]:
            ids = [self.begin, *ids]
        if ids[-1] != self.boundary:
            ids = [*ids, self.boundary]
        if len(ids) > self.limit:
            raise UsageError(
                f"instruction '{instruction[:60]}' makes a prompt of {len(ids)} tokens, at most {self.limit} are "
                "taken: shorten it, or import the checkpoint with more prompt_tokens"
            )
        return ids


def _tokenizer_of(path: Path) -> Any:
    if not path.is_file():
        raise CheckpointError(f"no {TOKENIZER} in {path.parent}: copy the one that was published with the checkpoint")
    try:
        from tokenizers import Tokenizer
    except ImportError as error:
        raise KervError("OpenVLA checkpoints need the package tokenizers: pip install 'kerv[openvla]'") from error
    try:
        return Tokenizer.from_file(str(path))
    except Exception as error:
        raise CheckpointError(f"{path} cannot be read ({str(error)[:120]}): copy it again") from error
