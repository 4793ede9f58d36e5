"""Compare a target with OpenVLA as the `transformers` package computes it: `kerv build target … check=true`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import gelu, linear

from kerv_cli.base.errors import UsageError
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.decoder import Decoder
from kerv_cli.targets.openvla.config import read_shape
from kerv_cli.targets.openvla.inputs import pixels_of
from kerv_cli.targets.openvla.loading import open_shards

SAMPLES = ("pick up the cup", "put the spoon on the towel", "open the drawer", "stack the blocks")
"""Instructions of the observations that are compared. Their images are noise."""


def check_installed() -> None:
    """Check that transformers is installed.

    Raises:
        UsageError: transformers is not installed.
    """
    try:
        import transformers  # noqa: F401
    except ImportError as error:
        raise UsageError("check=true compares with transformers: pip install 'transformers>=5.23,<6'") from error


class Reference:
    """OpenVLA put together from transformers' Llama, Dinov2WithRegisters and Siglip.

    Args:
        folder: Folder of the checkpoint.
        device: Device of the weights.
        dtype: Number format of the weights.

    Raises:
        UsageError: The package is not installed.
        CheckpointError: The checkpoint is damaged.
    """

    def __init__(self, folder: Path, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> None:
        check_installed()
        self.shape, self.device, self.dtype = read_shape(folder), device, dtype
        self.state = dict(open_shards(folder).items())
        self.dino, self.siglip, self.llama = self._dino(), self._siglip(), self._llama()

    def _part(self, prefix: str) -> dict[str, Tensor]:
        return {k.removeprefix(prefix): v for k, v in self.state.items() if k.startswith(prefix)}

    def _loaded(self, model: Any, weights: Mapping[str, Tensor], strict: bool = False) -> Any:
        """Return a model with these weights, all of which it must know."""
        assert not model.load_state_dict(weights, strict=strict).unexpected_keys
        return model.to(device=self.device, dtype=self.dtype).eval()

    def _dino(self) -> Any:
        from transformers import Dinov2WithRegistersConfig, Dinov2WithRegistersModel

        tower = self.shape.towers[0]
        config = Dinov2WithRegistersConfig(
            hidden_size=tower.width,
            num_hidden_layers=tower.depth - 1,  # OpenVLA takes the last but one
            num_attention_heads=tower.heads,
            mlp_ratio=tower.feed_forward // tower.width,
            num_register_tokens=tower.registers,
            image_size=tower.image,
            patch_size=tower.patch,
        )
        own = self._part("vision_backbone.featurizer.")
        weights = {
            "embeddings.cls_token": own["cls_token"],
            "embeddings.mask_token": torch.zeros(1, tower.width),
            "embeddings.register_tokens": own["reg_token"],
            # timm adds positions to the patches alone: transformers' class token gets a position of zero
            "embeddings.position_embeddings": torch.cat([torch.zeros(1, 1, tower.width), own["pos_embed"]], 1),
            "embeddings.patch_embeddings.projection.weight": own["patch_embed.proj.weight"],
            "embeddings.patch_embeddings.projection.bias": own["patch_embed.proj.bias"],
        }
        names = {name: name for name in ("norm1", "norm2", "mlp.fc1", "mlp.fc2")}
        names |= {"attn.proj": "attention.o_proj", "qkv": "attention"}
        for i in range(tower.depth - 1):
            layer = _block(own, f"blocks.{i}", names)
            layer |= {f"layer_scale{n}.lambda1": own[f"blocks.{i}.ls{n}.scale_factor"] for n in (1, 2)}
            weights |= {f"encoder.layer.{i}.{k}": v for k, v in layer.items()}
        return self._loaded(Dinov2WithRegistersModel(config), weights)

    def _siglip(self) -> Any:
        from transformers import SiglipVisionConfig, SiglipVisionModel

        tower = self.shape.towers[1]
        config = SiglipVisionConfig(
            hidden_size=tower.width,
            intermediate_size=tower.feed_forward,
            num_hidden_layers=tower.depth - 1,
            num_attention_heads=tower.heads,
            image_size=tower.image,
            patch_size=tower.patch,
            hidden_act="gelu",  # timm's; transformers' own default is its tanh approximation
        )
        own = self._part("vision_backbone.fused_featurizer.")
        weights = {
            "embeddings.patch_embedding.weight": own["patch_embed.proj.weight"],
            "embeddings.patch_embedding.bias": own["patch_embed.proj.bias"],
            "embeddings.position_embedding.weight": own["pos_embed"][0],
        }
        names = {"norm1": "layer_norm1", "norm2": "layer_norm2", "mlp.fc1": "mlp.fc1", "mlp.fc2": "mlp.fc2"}
        names |= {"attn.proj": "self_attn.out_proj", "qkv": "self_attn"}
        for i in range(tower.depth - 1):
            weights |= {f"encoder.layers.{i}.{k}": v for k, v in _block(own, f"blocks.{i}", names).items()}
        return self._loaded(SiglipVisionModel(config), weights)

    def _llama(self) -> Any:
        from transformers import LlamaConfig, LlamaForCausalLM

        numbers = asdict(self.shape.language)
        rope = {"rope_type": "default", "rope_theta": numbers.pop("rope_theta")}
        model = LlamaForCausalLM(LlamaConfig(**numbers, rope_parameters=rope))
        return self._loaded(model, self._part("language_model."), strict=True)

    def patches(self, pixels: Tensor) -> Tensor:
        """Map an image (1, 6, s, s) to vision tokens (1, n, E): both towers without final norm, then the projector."""
        pixels = pixels.to(self.device, self.dtype)
        first = self.dino(pixels[:, :3], output_hidden_states=True).hidden_states[-1]
        second = self.siglip(pixels[:, 3:], output_hidden_states=True).hidden_states[-1]
        x = torch.cat([first[:, 1 + self.shape.towers[0].registers :], second], -1)
        for number in (1, 2, 3):
            layer = {k: v.to(self.device, self.dtype) for k, v in self._part(f"projector.fc{number}.").items()}
            x = linear(x, layer["weight"], layer["bias"])
            x = gelu(x) if number < 3 else x
        return x

    def prompt(self, pixels: Tensor, ids: list[int]) -> Tensor:
        """Return the prompt (1, P, E) for an image (1, 6, s, s) and the ids of a text."""
        words = self.llama.model.embed_tokens(torch.tensor([ids], device=self.device))
        return torch.cat([words[:, :1], self.patches(pixels), words[:, 1:]], 1)

    @torch.inference_mode()
    def logits(self, pixels: Tensor, ids: list[int], following: list[int]) -> Tensor:
        """Return the logits after the prompt and after each of n following ids, in one forward.

        Args:
            pixels: (1, 6, s, s) image.
            ids: Ids of the prompt's text.
            following: The n ids after the prompt.

        Returns:
            (n + 1, vocabulary).
        """
        prompt = self.prompt(pixels, ids)
        after = self.llama.model.embed_tokens(torch.tensor([following], dtype=torch.long, device=self.device))
        found: Tensor = self.llama(inputs_embeds=torch.cat([prompt, after], 1)).logits[0, prompt.shape[1] - 1 :]
        return found


def _block(state: Mapping[str, Tensor], block: str, names: Mapping[str, str]) -> dict[str, Tensor]:
    """Return a vision block's weights under transformers' names.

    Args:
        state: Weights of the tower.
        block: Name of the block.
        names: Our name of a layer -> theirs. `qkv` is split into three.
    """
    found: dict[str, Tensor] = {}
    for kind in ("weight", "bias"):
        found |= {
            f"{theirs}.{kind}": state[f"{block}.{ours}.{kind}"] for ours, theirs in names.items() if ours != "qkv"
        }
        split = zip("qkv", state[f"{block}.attn.qkv.{kind}"].chunk(3), strict=True)
        found |= {f"{names['qkv']}.{part}_proj.{kind}": chunk for part, chunk in split}
    return found


def parity(target: Any) -> dict[str, float]:
    """Decode sample observations, and compare each token and its logits with those of the transformers package.

    Both compute the logits of a token after the same prompt and the same earlier tokens.

    Args:
        target: An `OpenVLATarget`. The `Reference` is loaded in float32, then moved to its device and number format.

    Returns:
        Numbers by name, in this order:

        - Tokens that were compared.
        - Tokens that differ from transformers' most probable action token.
        - Of the differing tokens, those whose two largest logits are equal in bfloat16.
        - Of all compared tokens, those whose two largest logits are equal in bfloat16.
        - Tokens for which transformers' most probable id is not an action token.
        - Largest difference of two logits.

    Raises:
        UsageError: transformers is not installed.
    """
    reference = Reference(Path(target.settings.checkpoint), target.device, target.dtype)
    last, size = target.shape.vocabulary, target.settings.image_size
    compared = differing = at_ties = ties = elsewhere = 0
    worst = 0.0
    for seed, instruction in enumerate(SAMPLES):
        image = np.random.default_rng(seed).integers(0, 256, (size, size, 3), dtype=np.uint8)
        observation = Observation(np.zeros(0), np.zeros(0), instruction, {target.cameras[0]: image})
        tokens = Decoder(target).decode(observation).tokens
        chosen = target.settings
        pixels = pixels_of(image, target.shape, target.normalisations, chosen.crop, chosen.libero)
        ids = [last - 1 - token for token in tokens]
        logits = reference.logits(pixels, target.prompter.ids(instruction), ids[:-1]).float()
        theirs = logits[:, last - target.shape.bins : last].flip(-1)
        own = _own_logits(target, observation, tokens)
        first, second = own.bfloat16().topk(2).values.unbind(-1)
        tied = first == second
        differs = theirs.argmax(-1) != torch.tensor(tokens, device=theirs.device)
        compared, differing = compared + len(tokens), differing + int(differs.sum())
        ties, at_ties = ties + int(tied.sum()), at_ties + int((tied & differs).sum())
        elsewhere += int((logits.argmax(-1) < last - target.shape.bins).sum() + (logits.argmax(-1) >= last).sum())
        worst = max(worst, float((own - theirs).abs().max()))
    return {
        "tokens compared with transformers": compared,
        "tokens that differ": differing,
        "of these where two logits tie in bfloat16": at_ties,
        "ties of the two largest logits in bfloat16": ties,
        "tokens where transformers chooses no action": elsewhere,
        "largest difference of logits": worst,
    }


@torch.inference_mode()
def _own_logits(target: Any, observation: Observation, tokens: tuple[int, ...]) -> Tensor:
    """Return the target's logits (N, V) before each of N tokens, in one forward."""
    prompt = target.encode(observation)
    x = torch.cat([prompt, target.embed(torch.tensor([tokens[:-1]], device=target.device))], 1)
    hidden = target.forward(x, torch.arange(x.shape[1], device=target.device))
    logits: Tensor = target.head(hidden[0, prompt.shape[1] - 1 :]).float()
    return logits
