"""How fast is AR's token beside a plain numpy step with the same weights? A slow baseline makes every speedup false.

    python tests/plain_decoder.py [TARGET] [REPEATS]

The reference shares nothing with the package but the weights: it is a plain decoder in numpy, one token at a time, as
one would write it down. It also has to give the same tokens. Decodes of both take turns; times are per token."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import torch

from kerv_cli.engine.decoder import Decoder
from kerv_cli.engine.stopwatch import Stopwatch
from kerv_cli.targets.checkpoint import load_target
from kerv_cli.targets.compact.target import CompactTarget


class PlainStep:
    """A Llama-style trunk, its embedding and head in numpy: RMSNorm, RoPE with split halves, SwiGLU."""

    def __init__(self, target: CompactTarget) -> None:
        arrays = {name: tensor.float().numpy() for name, tensor in target.state_dict().items()}
        self.layers = []
        for i in range(target.settings.layers):
            of = {name: arrays[f"trunk.layers.{i}.{name}.weight"] for name in ("qkv", "out", "gate_up", "down")}
            norms = [arrays[f"trunk.layers.{i}.{name}.weight"] for name in ("attention_norm", "feed_norm")]
            self.layers.append(({k: np.ascontiguousarray(v) for k, v in of.items()}, norms))
        self.norm, self.embedding = arrays["trunk.norm.weight"], arrays["embedding.weight"]
        self.head, self.heads = np.ascontiguousarray(arrays["head.weight"]), target.heads
        self.channels = target.width // target.heads
        self.frequency = 10_000.0 ** (-np.arange(0, self.channels, 2) / self.channels)

    def begin(self, keys: np.ndarray, values: np.ndarray, room: int) -> None:
        """keys, values (layers, heads, S, C) of the prompt; room: tokens to come."""
        shape = (*keys.shape[:2], keys.shape[2] + room, keys.shape[3])
        self.keys, self.values, self.length = np.zeros(shape, np.float32), np.zeros(shape, np.float32), keys.shape[2]
        self.keys[:, :, : self.length], self.values[:, :, : self.length] = keys, values

    def turned(self, x: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """x (heads, C) rotated."""
        half = self.channels // 2
        cos, sin = np.cos(angle).astype(np.float32), np.sin(angle).astype(np.float32)
        first, second = x[:, :half], x[:, half:]
        return np.concatenate([first * cos - second * sin, second * cos + first * sin], 1)

    def __call__(self, token: int) -> int:
        """The token behind this one."""
        x, stop = self.embedding[token].copy(), self.length + 1
        angle = self.length * self.frequency
        for i, (w, (before, behind)) in enumerate(self.layers):
            q, k, v = (w["qkv"] @ self.rms(x, before)).reshape(3, self.heads, self.channels)
            self.keys[i, :, self.length], self.values[i, :, self.length] = self.turned(k, angle), v
            scores = np.matmul(self.keys[i, :, :stop], self.turned(q, angle)[:, :, None])[:, :, 0]
            scores = np.exp(scores / np.float32(self.channels**0.5) - scores.max() / np.float32(self.channels**0.5))
            scores /= scores.sum(1, keepdims=True)
            x += w["out"] @ np.matmul(scores[:, None], self.values[i, :, :stop]).reshape(-1)
            gate, up = np.split(w["gate_up"] @ self.rms(x, behind), 2)
            x += w["down"] @ (gate / (1 + np.exp(-gate)) * up)
        self.length = stop
        return int(np.argmax(self.head @ self.rms(x, self.norm)))

    def rms(self, x: np.ndarray, gain: np.ndarray) -> np.ndarray:
        """RMSNorm."""
        return x / np.sqrt(np.mean(x * x) + np.float32(1e-5)) * gain


@torch.inference_mode()
def main(name: str, repeats: int) -> bool:
    """Prints the times -> whether all tokens are the same."""
    torch.set_num_threads(1)
    folder = Path(name) if Path(name).is_dir() else Path("results/pretrained") / name / "target"
    target, _ = load_target(folder, "cpu", torch.float32)
    decoder, plain = Decoder(target), PlainStep(target)
    seconds, same = [], True
    for seed in range(repeats):
        prompt = torch.randn(1, target.max_prompt, target.width, generator=torch.Generator().manual_seed(seed))
        stopwatch = Stopwatch(target.device)
        chunk = decoder.decode_prompt(prompt, stopwatch)
        cached = decoder.cache.buffer[:, :, 0, :, : target.max_prompt].numpy()
        plain.begin(cached[:, 0], cached[:, 1], chunk.size)
        begun, tokens = time.perf_counter(), chunk.tokens[:1]
        for _ in range(chunk.size - 1):
            tokens.append(plain(tokens[-1]))
        seconds.append(
            (stopwatch.phases["verify"] / (chunk.size - 1), (time.perf_counter() - begun) / (chunk.size - 1))
        )
        same &= tokens == chunk.tokens
    ours, theirs = np.array(seconds).T * 1e3
    print(
        f"AR's token {np.median(ours):.3f} ms (best {ours.min():.3f}), a plain numpy step {np.median(theirs):.3f} ms "
        f"(best {theirs.min():.3f}): ratio {np.median(ours / theirs):.2f}; the same tokens: {same}"
    )
    return same


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "mt10-vision", int(sys.argv[2]) if len(sys.argv) > 2 else 100)
